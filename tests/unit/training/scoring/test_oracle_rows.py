"""What is replaced by the truth is the truth, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.networks.place_encoder import PairHead
from tests.unit.ngo_estimator.rooms import camera_pair_head, drive_with_a_camera
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head, trajectory_inputs
from training.baselines.loop_factors import LoopFactors, exact_revisits, found_loops
from training.baselines.pose_graph import PoseGraphSettings
from training.scoring.oracle_rows import (
    LIMITS,
    InformedOptimizer,
    Limit,
    apart,
    exact_factors,
    exact_loops,
    right_factors,
    told,
)
from training.scoring.row_estimators import Arrays, local, optimized_by, pose_graph, seen_in
from training.scoring.table_rows import ROWS

STEPS, BLOCK = 96, 8


def arrays() -> Arrays:
    names = ("relative", "log_std", "motion", "codes")
    values = trajectory_inputs(3, STEPS)
    found = {name: value.numpy() for name, value in zip(names, values, strict=True)}
    rng = np.random.default_rng(0)
    true = found["relative"] + rng.normal(0.0, 0.02, found["relative"].shape)
    return {**found, "origin_code": found["codes"][:, :1], "truth": local({"relative": true})}


@pytest.fixture(scope="module")
def pair_head() -> PairHead:
    return small_pair_head()


def test_limits_are_of_rows_that_are_there() -> None:
    assert {limit.row for limit in LIMITS.values()} <= set(ROWS)
    assert not set(LIMITS) & set(ROWS)


def test_only_what_is_told_is_true() -> None:
    some = arrays()
    true = se2.g2r(torch.from_numpy(some["truth"])).numpy()
    turned, moved = (told(some, Limit("", "ngo_5", **change)) for change in ({"headings": True}, {"positions": True}))
    np.testing.assert_allclose(np.sin(turned["relative"][..., 2] - true[..., 2]), 0.0, atol=1e-6)
    np.testing.assert_array_equal(turned["relative"][..., :2], some["relative"][..., :2])
    np.testing.assert_allclose(moved["relative"][..., :2], true[..., :2], atol=1e-6)
    np.testing.assert_array_equal(moved["relative"][..., 2], some["relative"][..., 2])
    np.testing.assert_allclose(some["log_std"] - turned["log_std"], np.log([1.0, 1.0, 10.0]) + 0 * true, atol=1e-5)
    # Both together are the true trajectory.
    both = told(some, Limit("", "ngo_5", headings=True, positions=True))
    np.testing.assert_allclose(local(both)[..., :2], some["truth"][..., :2], atol=1e-4)
    assert told(some, Limit("", "ngo_5")) is some


def test_what_is_told_is_not_smoothed_any_more(pair_head: PairHead) -> None:
    some, optimizer = arrays(), small_optimizer("smoothed", trained=True)
    some["log_std"] = some["log_std"] - 1.5  # so that corrections are small
    bare, smooth = apart(optimizer)
    assert bare.config.smoother is None
    # In meta-poses the two are what the optimizer is; within these it spreads over the steps what smoothing changed.
    whole, parts = optimized_by(optimizer, pair_head)(some), optimized_by(bare, pair_head)(smooth(some))
    np.testing.assert_allclose(parts[:, BLOCK - 1 :: BLOCK], whole[:, BLOCK - 1 :: BLOCK], atol=0.05)
    true = told(smooth(some), Limit("", "ngo_5", headings=True, positions=True))
    steps = bare.aggregate(*(torch.from_numpy(true[name]).float() for name in ("relative", "log_std", "motion")))
    ends = torch.from_numpy(some["truth"][:, BLOCK - 1 :: BLOCK])
    torch.testing.assert_close(se2.wrapped(steps.relative - se2.g2r(ends)), torch.zeros(3, STEPS // BLOCK, 3).double(),
                               atol=1e-4, rtol=0.0)  # fmt: skip
    plain = small_optimizer("loops")
    assert apart(plain)[0] is plain and apart(plain)[1](some) is some


def test_exact_loops_agree_with_the_true_poses(pair_head: PairHead) -> None:
    some, optimizer = arrays(), small_optimizer("loops", trained=True)
    relative, codes = (torch.from_numpy(some[name]).float() for name in ("relative", "codes"))
    truth = torch.from_numpy(some["truth"])
    found = optimizer.find_loops(relative, codes, pair_head)
    exact = exact_loops(found, truth, BLOCK)
    nodes = torch.cat((torch.zeros(3, 1, 3).double(), truth[:, BLOCK - 1 :: BLOCK]), dim=1)
    for k in range(3):
        expected = se2.between(nodes[k, found.start[k]], nodes[k, found.end[k] + 1])
        torch.testing.assert_close(exact.measured[k], expected.float(), atol=1e-5, rtol=1e-5)
    poses = optimized_by(optimizer, pair_head)(some)
    informed = optimized_by(optimizer, pair_head, informed=InformedOptimizer)(some)
    assert informed.shape == poses.shape and not np.allclose(informed, poses, atol=1e-4)


def test_overlaps_that_are_found_later_are_exact_too() -> None:
    relative, log_std, codes, truth = drive_with_a_camera(160)
    search = LoopSearch(2, 8, 3, 0, 1, registrations=5, overlaps=20)
    optimizer = small_optimizer("gauss_newton", iterations=5, search=search)
    found = optimizer.find_loops(relative, codes, camera_pair_head())
    result = InformedOptimizer(optimizer, truth)(relative, log_std, torch.zeros(1, 160, 6), found)
    overlaps = slice(found.start.shape[1], None)
    assert result.loops.valid[:, overlaps].sum() > 8
    nodes = torch.cat((torch.zeros(1, 3).double(), truth[0, BLOCK - 1 :: BLOCK]))
    expected = se2.between(nodes[result.loops.start[0, overlaps]], nodes[result.loops.end[0, overlaps] + 1])
    torch.testing.assert_close(result.loops.measured[0, overlaps], expected.float(), atol=1e-5, rtol=1e-5)


def test_exact_factors_are_what_the_oracle_would_measure() -> None:
    truth = arrays()["truth"][0]
    oracle = exact_revisits(truth, PoseGraphSettings().search, BLOCK)
    off = replace(oracle, measured=oracle.measured + 0.3)
    np.testing.assert_allclose(exact_factors(off, truth, BLOCK).measured, oracle.measured, atol=1e-9)


def test_wrong_loops_are_left_out() -> None:
    truth = arrays()["truth"][0]
    start, end = np.array([0, 1, 2, 3]), np.array([7, 8, 9, 10])
    blank = LoopFactors(start, end, np.zeros((4, 3)), np.zeros((4, 2)), np.full(4, 5.0))
    found = exact_factors(blank, truth, BLOCK)
    found.measured[:] += [[0.4, 0.0, 0.0], [0.6, 0.0, 0.0], [0.0, 0.0, np.radians(11.0)], [0.0, 0.0, 2.0 * np.pi]]
    assert right_factors(found, truth, BLOCK).start.tolist() == [0, 3]


def test_the_classical_graph_takes_what_is_known(pair_head: PairHead) -> None:
    some, settings = arrays(), PoseGraphSettings(min_logit=-100.0, kernel="none")
    exact = pose_graph("gtsam", settings, pair_head, lambda found, true: exact_factors(found, true, BLOCK))(some)
    plain = pose_graph("gtsam", settings, pair_head)(some)
    assert found_loops(pair_head, seen_in(some), settings.search)[0].start.size

    def error(poses: np.ndarray) -> float:
        return float(np.linalg.norm((poses - some["truth"])[..., :2], axis=-1).mean())

    assert error(exact) < 0.5 * error(plain)
