"""The mixture front end over drives whose truth is known."""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.data.relative_step import RelativeStep, check_step
from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame, UnusableImage
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_recordings.scan_stream import LidarScan, WheelPose
from tests.unit.ngo_estimator.ray_casting import CORRIDOR, HALLWAY, ROOM, cast, fan, walls

ANGLES = fan(181, 240.0)
PERIOD_NS = 100_000_000


def way(count: int, x: float = 1.0, y: float = 1.0, yaw: float = 0.2) -> np.ndarray:
    poses = [np.array((x, y, yaw))]
    for _ in range(count - 1):
        poses.append(compose(poses[-1], np.array((0.05, 0.0, 0.03))))
    return np.array(poses)


def scan(room: np.ndarray, pose: np.ndarray, k: int, range_max: float = 30.0) -> LidarScan:
    noise = np.random.default_rng(k).normal(0.0, 0.005, len(ANGLES))
    ranges = np.asarray(cast(room, pose, ANGLES) + noise, np.float32)
    increment = float(ANGLES[1] - ANGLES[0])
    return LidarScan(10**12 + k * PERIOD_NS, float(ANGLES[0]), increment, ranges, 0.05, range_max, 0.0, "laser")


def records(poses: np.ndarray, wheels: bool = True, room: np.ndarray = ROOM) -> list[LidarScan | WheelPose]:
    result: list[LidarScan | WheelPose] = []
    for k, pose in enumerate(poses):
        if wheels:
            result.append(WheelPose(10**12 + k * PERIOD_NS, between(poses[0], pose)))
        result.append(scan(room, pose, k))
    return result


def fed(given: Iterable[LidarScan | WheelPose], lidar: MixtureLidar | None = None) -> list[RelativeStep]:
    lidar, steps = lidar or MixtureLidar(), []
    for record in given:
        if isinstance(record, WheelPose):
            lidar.add_wheels(record.stamp_ns, record.pose_xyyaw)
        else:
            lidar.add_scan(record)
        steps += list(lidar.ready())
    steps += list(lidar.ready(at_end=True))
    for step in steps:
        check_step(step, 0, None)
    return steps


def off(steps: list[RelativeStep], poses: np.ndarray) -> float:
    last = between(between(poses[0], poses[-1]), steps[-1].odom_xyyaw)
    return math.hypot(last[0], last[1]) + abs(last[2])


@pytest.mark.parametrize("weights", [(0.45, 0.2, 0.0, 0.0, 0.0, 0.03), (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)])
def test_where_anything_alone_is_left_it_is_searched(weights: tuple[float, ...]) -> None:
    poses = way(20)
    steps = fed(records(poses, wheels=False), MixtureLidar(MixtureConfig(first_weights=weights)))
    assert len(steps) == 19 and off(steps, poses) < 0.05


@pytest.mark.parametrize("wheels", [True, False])
def test_a_drive_through_a_room_is_measured_again_and_alike(wheels: bool) -> None:
    poses = way(50)
    steps, again = fed(records(poses, wheels)), fed(records(poses, wheels))
    assert len(steps) == 49 and off(steps, poses) < 0.05
    assert not any(step.unsure or step.segment for step in steps)
    for a, b in zip(steps, again, strict=True):
        np.testing.assert_array_equal(a.odom_xyyaw, b.odom_xyyaw)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_wheels_that_stand_still_do_not_hold_a_robot_that_drives() -> None:
    poses = way(50)
    given = [replace(each, pose_xyyaw=np.zeros(3)) if isinstance(each, WheelPose) else each for each in records(poses)]
    assert off(fed(given), poses) < 0.05


def test_bunched_stamps_cost_nothing() -> None:
    """Every fifth scan is in time; the four before it are stamped just before it."""
    poses = way(60)
    bunched = [
        replace(each, stamp_ns=10**12 + (-(-k // 5) * 5) * PERIOD_NS - (-k % 5) * 1_000_000)
        for k, each in enumerate(scan(ROOM, pose, k) for k, pose in enumerate(poses))
    ]
    driven = [WheelPose(10**12 + k * PERIOD_NS, between(poses[0], pose)) for k, pose in enumerate(poses)]
    both = sorted([*bunched, *driven], key=lambda each: each.stamp_ns)
    steps = fed(both)
    assert [step.stamp_ns for step in steps] == [each.stamp_ns for each in bunched[1:]]
    assert off(steps, poses) < 0.05


def test_a_corridor_leaves_the_way_along_it_to_the_wheels() -> None:
    poses = np.stack((0.1 * np.arange(30), np.zeros(30), np.zeros(30)), -1)
    given = [
        replace(each, range_max=8.0) if isinstance(each, LidarScan) else each for each in records(poses, room=HALLWAY)
    ]
    steps = fed(given)
    assert off(steps, poses) < 0.05
    last = steps[-1].covariance
    assert last[0, 0] > 20.0 * last[1, 1]


def test_what_was_seen_before_decides_whether_a_scan_fits() -> None:
    lidar = MixtureLidar()
    fed(records(way(20)), lidar)
    core = lidar._core
    placed = core._submap._scans[-1][0][::4]
    new = np.stack((np.linspace(100.0, 110.0, 3 * len(placed)), np.full(3 * len(placed), 100.0)), -1)
    seen_through = 0.5 * placed + 0.5 * core._pose[:2]
    assert core._fits(np.concatenate((placed, new)), np.zeros(3))
    assert not core._fits(np.concatenate((seen_through, new)), np.zeros(3))
    assert not core._fits(new, np.zeros(3))
    assert core._fits(new[:5], np.zeros(3))  # so few contradict nothing


def test_without_wheels_a_robot_goes_on_where_nothing_changes() -> None:
    """Two pillars tell its motion; behind them the walls are smooth, and ranges look as if the robot stood."""
    left = ((2.0, 0.6), (2.3, 0.6), (2.3, 0.9), (2.0, 0.9))
    right = ((1.2, -0.8), (1.5, -0.8), (1.5, -0.5), (1.2, -0.5))
    hallway = walls(CORRIDOR, left, right)
    poses = np.stack((0.1 * np.arange(70), np.zeros(70), np.zeros(70)), -1)
    steps = fed(scan(hallway, pose, k, 6.0) for k, pose in enumerate(poses))
    assert steps[-1].odom_xyyaw[0] == pytest.approx(6.9, rel=0.25)
    assert steps[-1].odom_xyyaw[1] == pytest.approx(0.0, abs=0.05)


def test_without_wheels_a_robot_that_starts_at_once_is_followed() -> None:
    """From a turn on the spot at 0.15 m a scan: few rays meet the walls that tell it, and all of these do.

    A simulated maze, seen with noise of 1 cm; a range of 0 mm is none.
    """
    with np.load(Path(__file__).with_name("starts_at_once.npz")) as drive:
        ranges = np.where(drive["ranges_mm"] > 0, 1e-3 * drive["ranges_mm"], np.inf).astype(np.float32)
        how = float(drive["angle_min"]), float(drive["angle_increment"])
        scans = [
            LidarScan((10 + k) * PERIOD_NS, *how, row, 0.0, float(drive["range_max"]), 0.0, "laser")
            for k, row in enumerate(ranges)
        ]
        assert off(fed(scans), drive["poses"]) < 0.5


def test_without_wheels_a_log_that_keeps_a_scan_each_few_seconds_is_followed() -> None:
    """As recorders thin logs: a scan each 0.7 m or 25 deg, seconds apart."""
    poses = [np.array((1.0, 1.0, 0.3))]
    for step in [(0.7, 0.0, 0.0), (0.0, 0.0, 0.44), (0.7, 0.1, 0.1), (0.3, 0.0, 0.44), (0.0, 0.0, 0.44)] * 3:
        poses.append(compose(poses[-1], np.array(step)))
    times_s = np.cumsum(np.random.default_rng(0).uniform(2.0, 9.0, len(poses)))
    scans = [
        replace(scan(ROOM, pose, k), stamp_ns=10**12 + int(1e9 * at_s))
        for k, (pose, at_s) in enumerate(zip(poses, times_s, strict=True))
    ]
    steps = fed(scans)
    assert not any(step.segment for step in steps)
    assert off(steps, np.array(poses)) < 0.1


def test_a_robot_that_was_carried_while_all_was_silent_begins_a_segment() -> None:
    there = records(way(20))
    away = [
        replace(each, stamp_ns=each.stamp_ns + 30 * 1_000_000_000) for each in records(way(20, x=3.0, y=4.5, yaw=2.0))
    ]
    steps = fed([*there, *away])
    segments = [k for k, step in enumerate(steps) if step.segment]
    assert segments == [19]
    assert steps[19].key is not None and steps[19].covariance[0, 0] > 10.0


def test_a_robot_that_turned_far_while_no_scan_came_is_found_again() -> None:
    """Without wheels, 80 degrees in three seconds: far outside of what the last motion promises."""
    poses = way(20)
    turned = compose(poses[-1], np.array((0.1, -0.1, -1.4)))
    poses = np.concatenate((poses, [compose(turned, np.array((0.05 * k, 0.0, 0.0))) for k in range(5)]))
    given = records(poses, wheels=False)
    steps = fed([*given[:20], *(replace(each, stamp_ns=each.stamp_ns + 3 * 10**9) for each in given[20:])])
    assert not any(step.unsure or step.segment for step in steps)
    assert off(steps, poses) < 0.05


def swung(monkeypatch: pytest.MonkeyPatch, again: bool) -> float:
    """How far (rad) the turns are off, of a robot without wheels that swings while its scanner sweeps."""
    if not again:
        monkeypatch.setattr(MixtureLidar, "_swept_again", lambda *_: None)

    def pose_at(second: float) -> np.ndarray:
        return np.array((2.0 + 0.2 * second, 2.0, 0.3 * abs((5.0 * second + 2.0) % 4.0 - 2.0)))

    count, sweep_s, given = 24, 0.09, []
    for k in range(count):
        at_s = 0.1 * k + sweep_s * np.arange(len(ANGLES)) / len(ANGLES)
        rays = [cast(ROOM, pose_at(second), ANGLES[i : i + 1]) for i, second in enumerate(at_s)]
        ranges = np.concatenate(rays).astype(np.float32)
        given.append(replace(scan(ROOM, pose_at(0.1 * k), k), ranges=ranges, time_increment=sweep_s / len(ANGLES)))
    poses = [pose_at(0.1 * k) for k in range(count)]
    true = [between(a, b)[2] for a, b in zip(poses[:-1], poses[1:], strict=True)]
    off = [step.relative_xyyaw[2] - turn for step, turn in zip(fed(given), true, strict=True)]
    return float(np.sqrt(np.mean(np.square(off))))


def test_a_sweep_is_removed_by_the_motion_that_the_match_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the robot turns back the last motion foretells nothing: the match does."""
    by_match, by_last = swung(monkeypatch, True), swung(monkeypatch, False)
    assert by_match < 0.85 * by_last


def test_scans_that_cannot_be_used_are_refused() -> None:
    lidar, first = MixtureLidar(), scan(ROOM, way(1)[0], 10)
    lidar.add_scan(first)
    with pytest.raises(DuplicateFrame):
        lidar.add_scan(first)
    with pytest.raises(LateFrame):
        lidar.add_scan(replace(first, stamp_ns=first.stamp_ns - 1))
    with pytest.raises(UnusableImage):
        lidar.add_scan(replace(first, ranges=np.zeros(20_001, np.float32)))
    with pytest.raises(ValueError, match="expected three numbers"):
        lidar.add_wheels(first.stamp_ns, np.full(3, np.nan))
    lidar.add_scan(replace(first, stamp_ns=first.stamp_ns - 2 * 10**9))
    assert lidar.restarts == 1
