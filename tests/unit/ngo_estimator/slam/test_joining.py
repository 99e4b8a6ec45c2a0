"""A saved session that goes on from another start: the robot is found in its map, which then grows."""

import dataclasses
import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.checkpoint import load_local, load_place
from ngo_estimator.data.relative_step import LateStep, RejectedStep, RelativeStep
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.slam.bridge import bridged
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.joining import Joining
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.saved_state import read_state, write_state
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate
from tests.golden.drives import WEIGHTS, GoldenDrive, estimates
from tests.unit.ngo_estimator.lidar_steps import HOUSE, drifted, lidar_steps, loop_way
from tests.unit.ngo_estimator.ray_casting import ROOM, fan, round_trip, scan_at
from tests.unit.ngo_estimator.slam.test_saved_state import assert_same
from training.data.episodes import episodes_in
from training.data.features import features_of
from training.data.worlds import MazeSize, world_named
from training.scoring.online_estimate import steps_of

ORIGIN = MapOrigin.of_first_pose(np.array((1.0, -2.0, 0.5)))
LATER_NS = 10**15
MAZE, OTHER_MAZE = 900_000_101, 900_000_102  # Seeds of no training and no table.


@dataclasses.dataclass(frozen=True)
class Drive:
    """Steps of a drive, and the true poses ``(frames, 3)``, in the maze's own frame."""

    steps: list[RelativeStep]
    truth: np.ndarray

    def again(self) -> list[RelativeStep]:
        """The same steps, later, of an odometry of their own."""
        return [later(step) for step in self.steps]


def later(step: RelativeStep) -> RelativeStep:
    key = step.key and dataclasses.replace(
        step.key,
        from_key_stamp_ns=step.key.from_key_stamp_ns + LATER_NS,
        scan=dataclasses.replace(step.key.scan, stamp_ns=step.key.scan.stamp_ns + LATER_NS),
    )
    stamps = (step.stamp_ns, step.from_stamp_ns, step.origin_stamp_ns)
    moved = dict(zip(("stamp_ns", "from_stamp_ns", "origin_stamp_ns"), (s + LATER_NS for s in stamps), strict=True))
    return dataclasses.replace(step, **moved, key=key, origin_scan=None)


@lru_cache
def maze_drive(world_name: str, maze: int, seed: int, frames: int) -> Drive:
    world, folder = world_named(world_name), WEIGHTS / world_name
    (episode,) = episodes_in(world, [maze], [seed], frames, MazeSize(rows=4, extra_openings=2), "random_goals")
    features = features_of(world, episode, folder, (load_local(folder)[0], load_place(folder)[0]))
    return Drive(list(steps_of(features)), episode.poses_xyyaw)


def lidar_drive(segments: np.ndarray, way: np.ndarray, seed: int) -> Drive:
    generator = np.random.default_rng(seed)

    def scan(k: int, stamp_ns: int) -> KeyScan:
        return scan_at(segments, way[k], stamp_ns, fan(181, 270.0), noise=(0.01, generator))

    odometry = drifted(np.array([between(way[0], pose) for pose in way]), (0.01, 0.005, 0.004))
    return Drive(list(lidar_steps(odometry, scan)), way)


def house_drives() -> tuple[Drive, Drive, Drive]:
    """One way round the house; the other way, from another start; a drive through another room."""
    way = loop_way(1.1)
    other = way[len(way) // 2 :: -1] + (0.1, 0.15, math.pi)
    return lidar_drive(HOUSE, way, 0), lidar_drive(HOUSE, other, 1), lidar_drive(ROOM, round_trip(161), 2)


def new(world: str) -> CorrectedTrajectory:
    if world == "scan":
        return ScanTrajectory(iterations_per_step=1)
    return OnlineTrajectory.load(WEIGHTS / world, world=world, iterations_per_step=1)


def saved(core: CorrectedTrajectory, folder: Path) -> CorrectedTrajectory:
    write_state(folder, core.identity, core.state())
    return core.restored(read_state(folder, core.identity))


def joined(joining: Joining, core: CorrectedTrajectory, steps: list[RelativeStep]) -> Iterator[TrajectoryUpdate | None]:
    """What each step changed in the trajectory, None before it joins."""
    begun = False
    for step in steps:
        if begun:
            yield core.update(step)
            continue
        update = joining.update(step).joined
        begun = update is not None
        yield update


def rmse(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.square(poses - truth)[:, :2].sum(1).mean()))


@pytest.mark.parametrize(
    ("world", "most_m", "most_claim_m"), [("maze2d", 0.05, 0.25), ("maze3d", 0.4, 0.6), ("scan", 0.1, 0.3)]
)
def test_a_session_goes_on_from_another_start_in_one_map(
    world: str, most_m: float, most_claim_m: float, tmp_path: Path
) -> None:
    if world == "scan":
        first, second, elsewhere = house_drives()
    else:
        frames = {"maze2d": 300, "maze3d": 200}[world]
        first, second = (maze_drive(world, MAZE, MAZE + k, frames) for k in (0, 7))
        elsewhere = maze_drive(world, OTHER_MAZE, OTHER_MAZE, 70)
    mapped = new(world)
    for step in first.steps:
        mapped.update(step)
    core = saved(mapped, tmp_path / "state")
    # Another building is never taken for this one, and the map stays as it is.
    assert all(update is None for update in joined(Joining(core, ORIGIN), core, elsewhere.again()))
    assert_same(core, mapped)

    steps = second.again()
    updates = list(joined(Joining(core, ORIGIN), core, steps))
    at = next(k for k, update in enumerate(updates) if update is not None)
    update = updates[at]
    assert update is not None and update.stamp_ns == steps[at].stamp_ns and not (update.gap or update.restarted)
    trajectory, before = core.trajectory(), mapped.trajectory()
    assert trajectory is not None and before is not None and (np.diff(trajectory.stamps_ns) > 0).all()
    stays = np.isin(before.stamps_ns, trajectory.stamps_ns)  # of a lidar only key scans
    n = int(stays.sum())
    assert at < 0.6 * len(steps) and update.frames == n + 1
    start = first.truth[0]
    truth = np.array([between(start, pose) for pose in (*first.truth[stays], *second.truth[at + 1 :])])
    assert np.hypot(*(update.pose_xyyaw - truth[n])[:2]) < most_claim_m
    # A drive that is found at its first scans is as far off as the map, over its whole way.
    alone = rmse(before.poses_xyyaw, np.array([between(start, pose) for pose in first.truth[: len(before.stamps_ns)]]))
    assert alone < most_m
    bar_m = max(most_m, 1.25 * alone)
    assert max(rmse(trajectory.poses_xyyaw[:n], truth[:n]), rmse(trajectory.poses_xyyaw[n:], truth[n:])) < bar_m
    across = (trajectory.loops[:, 0] < n) & (trajectory.loops[:, 1] >= n) & (trajectory.loop_weights > 0.5)
    assert across.sum() >= 2
    # The odometry of the second drive lies behind that of the first, as it was.
    odometry = trajectory.odometry_xyyaw
    own = [step.odom_xyyaw for step in steps[at:]]
    assert between(odometry[n], odometry[-1]) == pytest.approx(between(own[0], own[-1]), abs=1e-9)

    # Saved in between, just behind the join, it goes on to the last bit.
    again = saved(mapped, tmp_path / "state")
    list(joined(Joining(again, ORIGIN), again, steps[: at + 2]))
    loaded = saved(again, tmp_path / "state")
    for step in steps[at + 2 :]:
        loaded.update(step)
    assert_same(loaded, core)


def test_what_is_not_later_or_cannot_join_is_refused_and_changes_nothing() -> None:
    first, second, _ = house_drives()
    core = new("scan")
    for step in first.steps[:60]:
        core.update(step)
    joining, before = Joining(core, ORIGIN), core.restored(core.state())
    newest = first.steps[59].stamp_ns
    with pytest.raises(LateStep, match=f"the loaded trajectory ends at {newest} ns; expected later stamps"):
        joining.update(dataclasses.replace(first.steps[3], origin_stamp_ns=5))
    steps = second.again()
    without_key = next(step for step in steps if step.key is None)
    with pytest.raises(RejectedStep, match="has no key scan"):
        core.join(without_key, np.zeros(3), np.eye(3))
    assert_same(core, before)
    with pytest.raises(RejectedStep):
        ScanTrajectory().join(steps[0], np.zeros(3), np.eye(3))


def test_a_told_pose_joins_at_the_next_key_scan() -> None:
    first, second, _ = house_drives()
    core = new("scan")
    for step in first.steps:
        core.update(step)
    joining, steps = Joining(core, ORIGIN), second.again()
    own = between(first.truth[0], second.truth[0])
    joining.set_pose(ORIGIN.poses(own), np.diag((0.05, 0.05, 0.02)) ** 2)
    updates = list(joined(joining, core, steps[:20]))
    at = next(k for k, step in enumerate(steps) if step.key is not None)
    assert [update is not None for update in updates] == [k >= at for k in range(20)]
    update = updates[at]
    expected = compose(own, steps[at].odom_xyyaw)
    # What the first key scan sees of the map counts, too: it moves the pose within what was said of it.
    assert update is not None
    assert (np.abs(between(expected, update.pose_xyyaw)) < 3.0 * np.array((0.05, 0.05, 0.02))).all()


def test_the_frames_before_the_join_stay_where_they_were() -> None:
    drive = GoldenDrive.load("maze2d")
    steps = estimates(drive, LocalOdometry.load(WEIGHTS / "maze2d"))[:101]  # five frames into a block
    core = new("maze2d")
    for step in steps:
        core.update(step)
    before, again = core.trajectory(), [later(step) for step in steps]
    assert before is not None
    # A robot that is told a pose which is off: the loops move what comes behind it, not what was before.
    off = compose(before.poses_xyyaw[40], np.array((0.1, 0.1, 0.05)))
    core.join(dataclasses.replace(again[39]), off, np.diag((0.2, 0.2, 0.1)) ** 2)
    for step in again[40:100]:
        core.update(step)
    core.finish()
    after = core.trajectory()
    assert after is not None
    assert np.abs(after.poses_xyyaw[:102] - before.poses_xyyaw)[:, :2].max() < 0.01
    assert after.poses_xyyaw[-1] == pytest.approx(before.poses_xyyaw[100], abs=0.01)


def test_of_a_lidars_drives_before_the_join_key_scans_stay_where_they_were() -> None:
    """So a robot that is found again each day keeps what the place needs, and not each frame of the year."""
    first, second, _ = house_drives()
    core = new("scan")
    for step in first.steps:
        core.update(step)
    before, nodes = core.trajectory(), len(core.planar_graph().ids)
    step = next(step for step in second.again() if step.key is not None)
    core.join(step, between(first.truth[0], second.truth[0]), np.eye(3))
    after = core.trajectory()
    assert before is not None and after is not None
    assert nodes + 1 <= len(after.stamps_ns) <= nodes + 2 < len(before.stamps_ns)
    at = np.searchsorted(before.stamps_ns, after.stamps_ns[:-1])
    np.testing.assert_array_equal(before.stamps_ns[at], after.stamps_ns[:-1])
    np.testing.assert_allclose(after.poses_xyyaw[:-1], before.poses_xyyaw[at], atol=1e-9)
    np.testing.assert_array_equal(after.odometry_xyyaw[:-1], before.odometry_xyyaw[at])
    np.testing.assert_array_equal(after.stamps_ns[after.loops], before.stamps_ns[before.loops])
    variance = np.append(0.0, np.cumsum(before.odometry_std.astype(np.float64) ** 2, axis=0)[:, 0])
    expected = np.sqrt(np.diff(variance[at]))
    np.testing.assert_allclose(after.odometry_std[:-1, 0], expected, rtol=1e-4)


def test_a_bridge_is_as_uncertain_as_both_ends_and_the_map() -> None:
    newest, found = np.array((1.0, 2.0, math.pi / 2.0)), np.array((1.0, 12.0, math.pi))
    relative, covariance = bridged(newest, np.diag((0.0, 0.0, 0.01**2)), found, np.diag((0.3, 0.1, 0.02)) ** 2)
    assert relative == pytest.approx((10.0, 0.0, math.pi / 2.0))
    # Along and across the way: 0.02 a metre of the map, and the lever of the newest heading, 10 m long.
    along, across = 0.1**2 + 0.2**2, 0.3**2 + 0.2**2 + 0.1**2
    assert np.diagonal(covariance) == pytest.approx((along, across, 0.01**2 + 0.02**2 + math.radians(1.0) ** 2))
