"""The benchmarks: their drives, their peers, and what they measure."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import camera_live, drives, lidar_tf
from benchmarks.core_speed import Watched, core_speed
from benchmarks.drives import Drive, drive_of, episodes, stamp_ns
from benchmarks.lidar_depth import WHEELS
from benchmarks.lidar_live import RATE_HZ, Arguments, frames_of
from benchmarks.long_run import stored_path_mb
from benchmarks.peers import Incremental, LevenbergMarquardt, Problem
from benchmarks.process_use import cpu_s, memory_mb
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.nodes.messages import to_ns
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_sim.building2d import Building2d
from ngo_sim.episodes import record_episode
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from tests.unit.ngo_estimator import rendered_room
from tests.unit.ngo_estimator.slam.test_online_trajectory import make_steps
from tests.unit.ngo_estimator.slam.test_saved_state import lidar_drive, networks, scans
from training.baselines.pose_graph import xyyaw
from training.common.records import WEIGHTS
from training.data.worlds import world_named


def test_a_right_correction_has_no_error_and_one_of_another_clock_that_of_the_way() -> None:
    drive = Building2d(FloorPlanConfig(), ScannerConfig(rays=4), WHEELS).record(12, 10_000.0, 60)
    true, wheels = between(drive.true_poses_xyyaw[0], drive.true_poses_xyyaw[50]), drive.wheel_poses_xyyaw[50]
    correction = compose(true, between(wheels, np.zeros(3)))
    assert lidar_tf.error(drive, lidar_tf.BEGIN_NS + 5 * 10**9, correction, 0.0) < 1e-9
    way_m = float(np.linalg.norm((wheels - drive.wheel_poses_xyyaw[45])[:2]))
    off_m = lidar_tf.error(drive, lidar_tf.BEGIN_NS + 5 * 10**9, correction, 0.5)
    assert off_m == pytest.approx(way_m) and way_m > 0.05


def test_the_parts_of_a_drive_follow_each_other() -> None:
    size = drives.SIZES["maze2d"]
    env = world_named("maze2d").make(size.rows, size.extra_openings)
    whole = record_episode(env, "corners", 26, 2000)
    parts = list(episodes("maze2d", 2000, 25, chunk=10))
    assert [len(part.actions) for part in parts] == [10, 10, 5]
    for name, least in (("observations", 1), ("poses_xyyaw", 1), ("actions", 0)):
        joined = np.concatenate([getattr(parts[0], name), *(getattr(part, name)[least:] for part in parts[1:])])
        assert np.array_equal(joined, getattr(whole, name)), name


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def drive(cache: Path) -> Drive:
    return drive_of("maze2d", 2000, 40, cache)


def test_a_drive_is_the_same_in_any_parts(cache: Path, drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drives, "_CHUNK", 16)
    parts = list(episodes("maze2d", 2000, 40, chunk=16))
    monkeypatch.setattr(drives, "episodes", lambda *_: iter(parts))
    again = drive_of("maze2d", 2000, 40, cache / "another")
    for name, value in vars(drive).items():
        assert getattr(again, name) == pytest.approx(np.asarray(value), abs=1e-2), name
    assert np.array_equal(again.truth, drive.truth)


def test_the_core_takes_the_steps(drive: Drive) -> None:
    core = OnlineTrajectory.load(WEIGHTS / "maze2d", 2000, "maze2d")
    for step in drive.steps():
        update = core.update(step)
        assert not update.gap
        assert not update.restarted
    trajectory = core.trajectory()
    assert trajectory is not None
    assert trajectory.stamps_ns.tolist() == [stamp_ns(frame) for frame in range(41)]
    assert trajectory.odometry_xyyaw[1:] == pytest.approx(drive.odometry())


WINDOW, LIVE = 400, 20


def test_watching_changes_nothing_and_sees_every_optimisation(cache: Path) -> None:
    watched, alone = Watched("maze2d", WINDOW), OnlineTrajectory.load(WEIGHTS / "maze2d", WINDOW, "maze2d", 128, 1)
    for step in drive_of("maze2d", 2000, WINDOW + LIVE, cache).steps():
        update, expected = watched.core.update(step), alone.update(step)
        assert np.array_equal(update.pose_xyyaw, expected.pose_xyyaw)
        if update.frames == WINDOW + watched.block - 1:
            problem, trajectory = watched.problem(), alone.trajectory()
    assert len(watched.optimisations.wall_ms) == (WINDOW + LIVE) // watched.block
    assert min(watched.optimisations.cpu_ms) > 0.0
    assert trajectory is not None
    assert len(problem.relative) == WINDOW // watched.block
    assert (problem.nodes[:, 1] * watched.block).tolist() == trajectory.loops[:, 1].tolist()


def test_everything_is_measured(cache: Path) -> None:
    result = core_speed("maze2d", 2000, WINDOW, LIVE, 3, cache)
    assert len(result["core_ms"]) == LIVE
    for name in ("optimize", "update", "gtsam_lm", "gtsam_lm_believed", "isam2", "isam2_default"):
        assert result[name]["ms"] > 0.0, name
    assert result["update"]["cpu_ms"] > result["optimize"]["cpu_ms"]
    errors = result["rmse_m"]
    assert max(errors["gtsam_lm"], errors["isam2"], errors["ours"]) < 2.0 * errors["odometry"]


SIDE, LAPS = 5, 3
COUNT = 4 * SIDE * LAPS


@pytest.fixture
def truth() -> np.ndarray:
    steps = np.tile([1.0, 0.0, 0.0], (COUNT, 1))
    steps[SIDE - 1 :: SIDE, 2] = np.pi / 2
    poses = se2.r2g(torch.from_numpy(steps)).numpy()
    return np.concatenate((np.zeros((1, 3)), poses))


def problem_of(truth: np.ndarray, wrong: int = 0) -> Problem:
    """Rounds of a square: an odometry that turns too much, a loop from each pose to the one a lap before."""
    poses = torch.from_numpy(truth)
    relative = se2.between(poses[:-1], poses[1:]).numpy() + [0.0, 0.0, 0.001]
    lap = 4 * SIDE
    nodes = np.stack((np.arange(COUNT + 1 - lap), np.arange(lap, COUNT + 1)), axis=1)
    measured = np.zeros((len(nodes), 3))
    measured[:wrong] = [2.0, -3.0, 1.0]
    return Problem(
        relative=relative,
        std=np.full((COUNT, 3), 0.01),
        nodes=nodes,
        measured=measured,
        loop_std=np.full((len(nodes), 3), 0.01),
        logit=np.where(np.arange(len(nodes)) < wrong, -1.0, 5.0),
    )


def in_order(problem: Problem) -> np.ndarray:
    incremental = Incremental()
    for count in range(1, len(problem.relative) + 1):
        so_far = problem.where(problem.nodes[:, 1] <= count)
        part = Problem(problem.relative[:count], problem.std[:count], *list(vars(so_far).values())[2:])
        estimate = incremental.update(*incremental.prepare(part))
        incremental.keep(estimate)
    return xyyaw(estimate)


def error_m(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(poses[:, :2] - truth[:, :2], axis=1).max())


def test_both_close_the_loops(truth: np.ndarray) -> None:
    problem = problem_of(truth)
    odometry = se2.r2g(torch.from_numpy(problem.relative)).numpy()
    for poses in (xyyaw(LevenbergMarquardt(problem).solve()), in_order(problem)):
        # A lap that turns too much lies beside itself: what the loops say is that it ends where it began.
        assert poses.shape == truth.shape
        assert np.abs(poses[4 * SIDE :: 4 * SIDE, :2]).max() < 0.05
        assert error_m(poses, truth) < 0.5 * error_m(odometry, truth[1:])


def test_a_kernel_keeps_wrong_loops_out(truth: np.ndarray) -> None:
    problem = problem_of(truth, wrong=2)
    right = problem.where(problem.logit > 0.0)
    assert len(right.nodes) == len(problem.nodes) - 2
    poses, expected = (xyyaw(LevenbergMarquardt(each).solve()) for each in (problem, right))
    assert error_m(poses, expected) < 0.05


@pytest.mark.parametrize("core", [networks(), scans()], ids=["networks", "lidar"])
def test_the_stored_path_holds_what_the_graph_keeps_of_each_frame(core: CorrectedTrajectory) -> None:
    steps = make_steps(140) if core.identity.get("window_frames") else lidar_drive()
    for step in steps:
        core.update(step)
    odometry_mb = 3 * 8 * (len(steps) + 1) / 2**20  # the graph's own odometry, beside the log's
    logged = [rows for rows in vars(core._log).values() if isinstance(rows, GrowingRows)]
    assert stored_path_mb(core) > sum(rows.values.nbytes for rows in logged) / 2**20 + odometry_mb


def test_the_scans_are_of_the_asked_size_at_40_hz() -> None:
    frames = frames_of(Arguments(scans=100, before=1, rays=1080))
    assert len(frames) == 101
    scans = [message for ((_, message),) in frames]
    assert {len(scan.ranges) for scan in scans} == {1080}
    stamps = [to_ns(scan.header.stamp) for scan in scans]
    assert [b - a for a, b in zip(stamps[:-1], stamps[1:], strict=True)] == pytest.approx([1e9 / RATE_HZ] * 100, abs=2)


def test_each_picture_comes_with_its_calibration_and_the_wheels() -> None:
    model, truth = rendered_room.camera(160), rendered_room.drive(8)
    rays, truth = rendered_room.rays_of(model), se2.between(truth[:1], truth)
    pictures = [rendered_room.picture(model, rays, pose)[..., 0] for pose in rendered_room.drive(8)]
    frames = camera_live.frames_of(camera_live.CameraDrive(pictures, truth, truth, model, 0.1))
    for number, ((_, image), (_, info), (_, wheels)) in enumerate(frames):
        assert to_ns(image.header.stamp) == to_ns(wheels.header.stamp) == 1_000_000_000 + round(number * 1e9 / 15.0)
        assert np.array_equal(np.reshape(image.data, (120, 160)), pictures[number])
        assert np.allclose(np.reshape(info.k, (3, 3)), model.matrix)
        at = wheels.pose.pose
        assert (at.position.x, at.position.y, 2.0 * at.orientation.z) == pytest.approx(tuple(truth[number]), abs=0.05)
    assert camera_live.keys_per_s(np.outer(np.arange(15.0), (0.4, 0.0, 0.0))) == pytest.approx(7.0)  # each 0.8 m


def test_a_process_has_used_time_and_memory() -> None:
    assert cpu_s(os.getpid()) > 0.0
    assert memory_mb(os.getpid()) > 1.0
