"""The rows' estimators: batches equal single trajectories, and prefixes know nothing of what follows."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import PLACE, SMOOTHER, PlaceNetworks, load_local, save_checkpoint, write_untrained
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from tests.unit.ngo_estimator.rooms import (
    camera_pair_head,
    drive_in_the_room,
    drive_with_a_camera,
    registering_pair_head,
)
from tests.unit.ngo_estimator.samples import place_config, small_optimizer, small_pair_head, trajectory_inputs
from training.baselines.pose_graph import PoseGraphSettings
from training.data.worlds import WORLDS, world_named
from training.scoring.row_estimators import (
    Arrays,
    Prepared,
    estimators,
    local,
    optimized_by,
    pose_graph,
    prefix,
    registered,
)
from training.scoring.table_rows import ROWS, Sources, rows_of

STEPS = 101  # twelve blocks of 8, and a tail


def arrays(trajectories: int = 3) -> Arrays:
    names = ("relative", "log_std", "motion", "codes")
    values = trajectory_inputs(trajectories, STEPS)
    found = {name: value.numpy() for name, value in zip(names, values, strict=True)}
    return {**found, "origin_code": np.zeros((trajectories, 1, 12)), "truth": local(found) + 0.01}


@pytest.fixture(scope="module")
def pair_head() -> PairHead:
    return small_pair_head()


@pytest.mark.parametrize("form", ["loops", "paper", "gauss_newton"])
@pytest.mark.parametrize("steps", [STEPS, 96])
def test_many_trajectories_come_out_as_single_ones(form: str, steps: int, pair_head: PairHead) -> None:
    optimizer = small_optimizer(form, trained=True)
    some = prefix(arrays(), steps)
    prepared: Prepared = {}
    poses = optimized_by(optimizer, pair_head, prepared)(some)
    assert poses.shape == (3, steps, 3) and poses.dtype == np.float64
    assert len(prepared) == (form != "paper")
    np.testing.assert_array_equal(optimized_by(optimizer, pair_head, prepared)(some), poses)
    moved = np.abs(poses - local(some)).max()
    assert moved > 5e-3
    for k in range(3):
        inputs = (torch.from_numpy(some[name][k]) for name in ("relative", "log_std", "motion", "codes"))
        single = optimize_offline(optimizer, pair_head, *inputs).poses[0].numpy()
        np.testing.assert_allclose(poses[k, :, :2], single[:, :2], atol=0.02 * moved)
        turn = poses[k, :, 2] - single[:, 2]
        np.testing.assert_allclose(np.remainder(turn + np.pi, 2 * np.pi) - np.pi, 0.0, atol=0.02 * moved)


def test_the_classical_graph_keeps_the_odometry_behind_the_last_whole_block(pair_head: PairHead) -> None:
    some = arrays()
    poses = pose_graph(PoseGraphSettings(), pair_head)(some)
    assert poses.shape == (3, STEPS, 3)
    steps = np.diff(poses[:, 95:, :2], axis=1)
    expected = np.diff(local(some)[:, 95:, :2], axis=1)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=2), np.linalg.norm(expected, axis=2), atol=1e-6)


def test_a_prefix_has_its_first_frame_and_nothing_that_follows() -> None:
    some = {"relative": np.arange(1, 101)[None], "origin_code": np.zeros((1, 1, 12))}
    for steps in (4, 30, 50, 100):
        seen = prefix(some, steps)
        assert seen["relative"].tolist() == [list(range(1, steps + 1))]
        assert seen["origin_code"].shape == (1, 1, 12)


def test_worlds_have_the_rows_that_are_theirs() -> None:
    in_2d, in_3d = (set(rows_of(WORLDS[name])) for name in ("maze2d", "maze3d"))
    assert in_3d - in_2d == {"local_no_action", "deepvo", "smoothed", "gtsam_smoothed"}
    assert in_2d - in_3d == {name for name, row in ROWS.items() if row.registered}


def test_what_is_smoothed_is_what_our_optimizer_takes(tmp_path: Path) -> None:
    optimizer = small_optimizer("smoothed", trained=True)
    write_untrained(tmp_path / "maze3d", "maze3d")
    local = load_local(tmp_path / "maze3d")[1]["sha256"]
    place = PlaceNetworks(place_config("maze3d", code_size=12))
    for kind, network in ((SMOOTHER, optimizer.smoother), (PLACE, place)):
        of = {"local_pose_network_sha256": local}
        save_checkpoint(tmp_path / "maze3d" / f"{kind}.safetensors", network, kind, "maze3d", of)
    sources = Sources(world_named("maze3d"), tmp_path, tmp_path, tmp_path)
    relative, log_std, motion, codes = (value.numpy() for value in trajectory_inputs(2, 40))
    some = {"relative": relative, "log_std": log_std, "motion": motion, "codes": codes, "origin_code": codes[:, :1]}
    some["truth"] = se2.r2g(torch.from_numpy(relative)).numpy()
    (smoothed,) = estimators("smoothed", 1, sources)
    steps = optimizer.aggregate(*(torch.from_numpy(some[name]) for name in ("relative", "log_std", "motion")))
    expected = se2.r2g(steps.relative)
    np.testing.assert_allclose(smoothed.poses(some)[:, 7::8], expected, atol=1e-5)
    # Of a prefix, nothing is known that follows.
    assert not np.allclose(smoothed.poses(prefix(some, 16))[:, 15], expected[:, 1], atol=1e-5)
    settings = dataclasses.asdict(PoseGraphSettings(min_logit=1e9))
    (tmp_path / "maze3d.gtsam_smoothed.json").write_text(json.dumps({"settings": settings}))
    (graph,) = estimators("gtsam_smoothed", 1, sources)
    np.testing.assert_allclose(graph.poses(some)[:, 7::8], expected, atol=1e-4)
    assert smoothed.identity != graph.identity


def test_what_is_registered_is_what_our_optimizer_takes() -> None:
    steps, head = 40, registering_pair_head()
    relative, log_std, codes, origin, truth = (value.numpy()[None] for value in drive_in_the_room(steps + 3))
    some = {"relative": relative, "log_std": log_std, "codes": codes, "origin_code": origin, "truth": truth}
    poses = registered(some, head)
    assert poses.shape == (1, steps + 3, 3)
    optimizer = small_optimizer(search=LoopSearch(2, 8, 2, 0, 3, registrations=5))
    inputs = (torch.from_numpy(array[:, :steps]) for array in (relative, log_std, codes))
    expected, _ = optimizer.registered(*inputs, head, torch.from_numpy(origin[:, 0]))
    np.testing.assert_allclose(poses[:, :steps], se2.r2g(expected.double()), atol=1e-5)
    errors = [np.linalg.norm((p - truth)[0, :steps, :2], axis=1).max() for p in (poses, local(some))]
    assert errors[0] < 0.2 * errors[1]
    settings = PoseGraphSettings(search=optimizer.config.search)
    graphs = [pose_graph(settings, head, registers) for registers in (False, True)]
    without, with_registered = (np.linalg.norm((g(some) - truth)[0, :steps, :2], axis=1).max() for g in graphs)
    assert with_registered < without


def test_frames_that_share_walls_help_our_optimizer_and_the_classical_graph() -> None:
    relative, log_std, codes, truth = (value.numpy() for value in drive_with_a_camera(160))
    some = {"relative": relative, "log_std": log_std, "codes": codes, "origin_code": codes[:, :1], "truth": truth}
    some["motion"] = np.zeros((1, 160, 6), np.float32)
    head, errors = camera_pair_head(), {}
    for overlaps in (0, 20):
        # No place is recognised.
        search = LoopSearch(2, 1, 3, 0, 1, registrations=5, overlaps=overlaps)
        settings = PoseGraphSettings(
            odometry_position_scale=1.0, odometry_heading_scale=1.0, min_logit=4.0, search=search
        )
        ours = small_optimizer("gauss_newton", iterations=5, search=search)
        for name, poses in (("ours", optimized_by(ours, head)), ("gtsam", pose_graph(settings, head))):
            errors[name, overlaps] = float(np.linalg.norm((poses(some) - truth)[..., :2], axis=-1).mean())
    for name in ("ours", "gtsam"):
        assert errors[name, 20] < 0.5 * errors[name, 0]
