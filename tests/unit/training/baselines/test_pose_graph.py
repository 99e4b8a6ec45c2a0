"""GTSAM beside our optimizer: the pose graph that is solved, and the loops that go into it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch, find_loops
from ngo_estimator.loops.overlaps import find_overlaps
from ngo_estimator.ngo.pose_aggregation import poses_in_blocks
from tests.unit.ngo_estimator.rooms import camera_pair_head, drive_with_a_camera
from tests.unit.ngo_estimator.samples import small_pair_head, with_origin
from training.baselines.loop_factors import LoopFactors, Seen, found_loops, overlaps_of
from training.baselines.pose_graph import PoseGraphSettings, optimize

PLAIN = PoseGraphSettings(
    odometry_position_scale=1.0,
    odometry_heading_scale=1.0,
    loop_position_scale=1.0,
    loop_heading_scale=1.0,
    kernel="none",
    drift_m=0.0,
)
LAP = 16  # Meta-steps of a lap.
NO_LOOPS = LoopFactors(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))


def laps(count: int, side_steps: int = 32) -> np.ndarray:
    """True steps ``(steps, 3)`` of laps around a square of 3.2 m; each of its corners is turned in one step."""
    side = np.tile([0.1, 0.0, 0.0], (side_steps, 1))
    side[-1, 2] = np.pi / 2.0
    return np.tile(side, (4 * count, 1))


def driven(steps: np.ndarray) -> np.ndarray:
    return se2.r2g(torch.from_numpy(steps)).numpy()


def noisy(steps: np.ndarray, std: float) -> np.ndarray:
    """Odometry that is off by chance, and turns a little too far with every step."""
    return steps + np.random.default_rng(0).normal(0.0, std, steps.shape) * [1.0, 0.3, 0.5] + [0.0, 0.0, 0.1 * std]


def stds(steps: np.ndarray, std: float) -> np.ndarray:
    return np.full(steps.shape, np.log(std))


def rmse(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.square(poses - truth)[:, :2].sum(-1).mean()))


def one_loop(start: int, end: int, measured: list[float], scale: float, logit: float = 5.0) -> LoopFactors:
    log_scale = np.log([[scale, scale]])
    return LoopFactors(np.array([start]), np.array([end]), np.array([measured]), log_scale, np.array([logit]))


def exact_loops(truth: np.ndarray, *laps: int) -> LoopFactors:
    """From each pose to those so many meta-steps later, as both truly are."""
    poses = torch.from_numpy(np.concatenate((np.zeros((1, 3)), truth[7::8])))
    start = np.concatenate([np.arange(len(poses) - lap) for lap in laps])
    end = np.concatenate([np.arange(lap, len(poses)) for lap in laps])
    measured = se2.between(poses[start], poses[end]).numpy()
    log_scale = np.full((len(start), 2), np.log(1e-3))
    return LoopFactors(start, end - 1, measured, log_scale, np.full(len(start), np.inf))


def together(a: LoopFactors, b: LoopFactors) -> LoopFactors:
    return LoopFactors(*(np.concatenate((vars(a)[name], vars(b)[name])) for name in vars(a)))


@pytest.mark.parametrize(
    ("scales", "end_m"),
    [
        # Two steps and the loop share the 0.3 m that it is longer, by their variances.
        ({}, 2.0 + 0.3 * 2.0 / 3.0),
        ({"odometry_position_scale": 2.0}, 2.0 + 0.3 * 8.0 / 9.0),
        ({"loop_position_scale": 2.0}, 2.0 + 0.3 * 2.0 / 6.0),
    ],
)
def test_a_graph_solved_by_hand(scales: dict[str, float], end_m: float) -> None:
    steps = np.tile([0.125, 0.0, 0.0], (16, 1))  # two meta-steps of 1 m
    log_std = stds(steps, 0.05 / np.sqrt(8.0))  # of 0.05 m each
    poses = optimize(steps, log_std, one_loop(0, 1, [2.3, 0.0, 0.0], 0.05), replace(PLAIN, **scales))
    assert poses.dtype == np.float64
    np.testing.assert_allclose(poses[:, 0], np.arange(1, 17) / 16 * end_m, atol=1e-6)
    np.testing.assert_allclose(poses[:, 1:], 0.0, atol=1e-6)


def test_a_loop_that_is_not_believed_does_nothing() -> None:
    steps = laps(1)
    loop = one_loop(0, 15, [1.0, 1.0, 0.0], 0.01, logit=-0.1)
    odometry = driven(steps)
    np.testing.assert_allclose(optimize(steps, stds(steps, 0.02), loop, PLAIN), odometry, atol=1e-6)
    believed = optimize(steps, stds(steps, 0.02), loop, replace(PLAIN, min_logit=-0.2))
    assert rmse(believed, odometry) > 0.1


@pytest.mark.parametrize("kernel", ["none", "dcs", "cauchy"])
def test_exact_loops_carry_an_exact_first_lap_over_to_the_others(kernel: Any) -> None:
    steps = laps(3)
    truth, first = driven(steps), len(steps) // 3
    odometry, log_std = noisy(steps, 0.03), stds(steps, 0.03)
    odometry[:first], log_std[:first] = steps[:first], np.log(1e-5)
    loops = exact_loops(truth, LAP)
    poses = optimize(odometry, log_std, loops, replace(PLAIN, kernel=kernel))
    ends = slice(7, None, 8)  # between meta-poses the odometry's own noise remains
    assert rmse(driven(odometry)[ends], truth[ends]) > 0.5
    assert rmse(poses[ends], truth[ends]) < 1e-3


@pytest.mark.parametrize("kernel", ["cauchy", "geman_mcclure", "dcs"])
def test_a_robust_kernel_rejects_a_false_loop(kernel: Any) -> None:
    steps = laps(3)
    truth = driven(steps)
    odometry, log_std = noisy(steps, 0.01), stds(steps, 0.01)
    loops = exact_loops(truth, LAP)
    loops = replace(loops, log_scale=np.full_like(loops.log_scale, np.log(0.02)))
    # Opposite corners of the square as one place.
    wrong = together(loops, one_loop(8, 31, [0.0, 0.0, 0.0], 0.02))
    right = rmse(optimize(odometry, log_std, loops, PLAIN), truth)
    assert rmse(optimize(odometry, log_std, wrong, PLAIN), truth) > 5.0 * right
    robust = replace(PLAIN, kernel=kernel, kernel_width=3.0)
    assert rmse(optimize(odometry, log_std, wrong, robust), truth) < 1.2 * right


def test_wrong_loops_are_left_out_though_the_odometry_is_far_beyond_what_measurements_allow() -> None:
    """Exact loops of a millimetre, an odometry that is decimetres off, and a third of the loops wrong."""
    rng = np.random.default_rng(0)
    steps, turn = 320, 2.0 * np.pi / 80.0
    true_steps = np.tile([0.1, 0.0, turn], (steps, 1))
    truth = se2.r2g(torch.from_numpy(true_steps)).numpy()
    odometry = true_steps + np.array([0.0, 0.0, 0.004])
    loops = exact_loops(truth, 11, 31)
    measured = loops.measured.copy()
    wrong = rng.random(len(measured)) < 0.33
    measured[wrong] += rng.uniform(-2.0, 2.0, (int(wrong.sum()), 3))
    loops = replace(loops, measured=measured)
    errors = {}
    for drift_m in (0.0, 1.0):
        settings = PoseGraphSettings(drift_m=drift_m, kernel="geman_mcclure", min_logit=0.0)
        poses = optimize(odometry, np.full((steps, 3), np.log(0.004)), loops, settings)
        errors[drift_m] = float(np.linalg.norm((poses - truth)[:, :2], axis=1).max())
    drifted = np.linalg.norm((se2.r2g(torch.from_numpy(odometry)).numpy() - truth)[:, :2], axis=1).max()
    assert errors[1.0] < 0.1 * drifted and errors[1.0] < 0.2 * errors[0.0], (errors, drifted)


def test_further_loops_are_asked_for_under_the_poses_without_them() -> None:
    true_steps = laps(3)
    truth, steps = driven(true_steps), noisy(true_steps, 0.02)
    exact = exact_loops(truth, LAP)
    asked: list[np.ndarray] = []

    def more(nodes: np.ndarray) -> LoopFactors:
        asked.append(nodes)
        return exact

    poses = optimize(steps, stds(steps, 0.02), NO_LOOPS, PLAIN, more=more)
    (nodes,) = asked
    np.testing.assert_allclose(nodes[1:, :2], driven(steps)[7::8, :2], atol=1e-6)
    np.testing.assert_allclose(poses, optimize(steps, stds(steps, 0.02), exact, PLAIN), atol=1e-6)


SEARCH = LoopSearch(per_pose=3, most=1000, min_separation=6, min_apart=1)


def drives(trajectories: int, steps: int = 160) -> Seen:
    rng = np.random.default_rng(0)
    relative = rng.normal(0.0, 0.1, (trajectories, steps, 3)).astype(np.float32)
    codes = rng.normal(0.0, 1.0, (trajectories, steps, 12)).astype(np.float16)
    return Seen(relative, np.full_like(relative, -4.0), codes, codes[:, :1])


def test_found_loops_are_those_of_the_optimizer_whatever_goes_with_them() -> None:
    seen = drives(11)
    found = found_loops(small_pair_head(), seen, SEARCH)
    assert len(found) == 11
    for number in (0, 7, 8, 10):
        inputs = (torch.from_numpy(array[number : number + 1]).float() for array in (seen.codes, seen.relative))
        loops = find_loops(small_pair_head(), next(inputs), poses_in_blocks(next(inputs), 8), SEARCH)
        valid = loops.valid[0]
        assert 0 < valid.sum() < len(valid)
        for name, value in vars(found[number]).items():
            np.testing.assert_allclose(value, getattr(loops, name)[0][valid].detach(), atol=1e-5, err_msg=name)


def test_overlaps_are_those_of_the_optimizer_under_the_graphs_poses() -> None:
    parts = [drive_with_a_camera(160, seed) for seed in (0, 1)]
    relative, _, codes, truth = (torch.cat(columns) for columns in zip(*parts, strict=True))
    search, head = LoopSearch(2, 8, 3, 0, 1, registrations=5, overlaps=20), camera_pair_head()
    nodes = with_origin(truth[:, 7::8])
    scans = head.scans(codes)
    assert scans is not None
    expected = find_overlaps(scans, poses_in_blocks(relative, 8), nodes, head.embed(codes[:, 7::8]), search)
    more = overlaps_of(head, codes.numpy(), relative.numpy(), search)
    assert len(more) == 2
    for k in (1, 0):
        found = more[k](nodes[k].numpy())
        valid = expected.valid[k]
        assert len(found.start) == valid.sum() > 8
        for name, value in vars(found).items():
            np.testing.assert_allclose(value, getattr(expected, name)[k][valid], atol=1e-4, err_msg=name)
    with pytest.raises(ValueError, match="the place codes hold no ranges; expected a registration"):
        overlaps_of(small_pair_head(), codes.numpy(), relative.numpy(), search)
