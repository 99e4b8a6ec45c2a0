"""Scans and wheels in any order, late, silent or broken: the local estimator of a lidar."""

import math
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ngo_estimator.data.relative_step import RelativeStep, check_step
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame, UnusableImage
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_recordings.scan_stream import LidarScan, WheelPose
from tests.unit.ngo_estimator.ray_casting import ROOM, cast, fan

BEGIN_NS = 10**12
STEP_NS = 100_000_000
ANGLES = fan(241, 240.0)


def way(count: int, turn: float = 0.03) -> np.ndarray:
    poses = [np.array((1.0, 1.0, 0.2))]
    for _ in range(count - 1):
        poses.append(compose(poses[-1], np.array((0.05, 0.0, turn))))
    return np.array(poses)


def scan_of(ranges: np.ndarray, k: int, angles: np.ndarray = ANGLES, **more: Any) -> LidarScan:
    values = {"range_min": 0.05, "range_max": 30.0, "time_increment": 0.0, "frame_id": "laser"} | more
    increment = float(angles[1] - angles[0]) if len(angles) > 1 else 0.01
    return LidarScan(BEGIN_NS + k * STEP_NS, float(angles[0]), increment, np.asarray(ranges, np.float32), **values)


def scans(poses: np.ndarray) -> list[LidarScan]:
    noise = np.random.default_rng(0)
    return [scan_of(cast(ROOM, pose, ANGLES) + noise.normal(0.0, 0.005, 241), k) for k, pose in enumerate(poses)]


def wheels(poses: np.ndarray, late_ns: int = 0) -> list[WheelPose]:
    """Wheels in a frame of their own, 3 % too long."""
    first = np.array((5.0, -2.0, 1.0))
    scaled = [between(poses[0], pose) * (1.03, 1.03, 1.0) for pose in poses]
    return [WheelPose(BEGIN_NS + k * STEP_NS + late_ns, compose(first, each)) for k, each in enumerate(scaled)]


def fed(odometry: MixtureLidar, records: Iterable[LidarScan | WheelPose], at_end: bool = True) -> list[RelativeStep]:
    steps = []
    for record in records:
        if isinstance(record, WheelPose):
            odometry.add_wheels(record.stamp_ns, record.pose_xyyaw)
        else:
            odometry.add_scan(record)
        steps += list(odometry.ready())
    return steps + (list(odometry.ready(at_end=True)) if at_end else [])


def merged(poses: np.ndarray, held: int) -> list[LidarScan | WheelPose]:
    """Wheels that come ``held`` scans after their own, or before it where that is negative."""
    ours, theirs = scans(poses), wheels(poses)
    keyed = [(k, 1, each) for k, each in enumerate(ours)] + [(k + held, 0, each) for k, each in enumerate(theirs)]
    return [each for _, _, each in sorted(keyed, key=lambda entry: entry[:2])]


def off(steps: list[RelativeStep], poses: np.ndarray) -> float:
    last = between(between(poses[0], poses[-1]), steps[-1].odom_xyyaw)
    return math.hypot(last[0], last[1]) + abs(last[2])


@pytest.mark.parametrize("held", [-5, 1, 2])
def test_wheels_may_come_before_or_after_their_scans(held: int) -> None:
    """Scans wait for their wheels: the result does not depend on who came first."""
    poses = way(60)
    together = fed(MixtureLidar(), merged(poses, 0))
    apart = fed(MixtureLidar(), merged(poses, held))
    assert len(together) == len(apart) == 59 and off(together, poses) < 0.05
    for a, b in zip(together, apart, strict=True):
        np.testing.assert_allclose(a.odom_xyyaw, b.odom_xyyaw, atol=0.01)  # the first scan waits for nobody
        assert b.robot_odom_xyyaw is not None or b is apart[0]


def test_silent_wheels_hold_up_nothing_for_long() -> None:
    poses = way(80)
    theirs = {each.stamp_ns: each for each in wheels(poses)[:30]}
    odometry, steps, most = MixtureLidar(), [], 0
    for scan in scans(poses):
        if scan.stamp_ns in theirs:
            odometry.add_wheels(scan.stamp_ns, theirs[scan.stamp_ns].pose_xyyaw)
        odometry.add_scan(scan)
        steps += list(odometry.ready())
        most = max(most, odometry.waiting)
    assert most <= 4 and odometry.waiting == 0 and len(steps) == 79
    assert off(steps, poses) < 0.05
    robot = np.array([step.robot_odom_xyyaw for step in steps], np.float64)
    assert np.abs(np.diff(robot, axis=0)[:, :2]).max() < 0.1  # goes on by our own steps


def test_after_a_pause_of_both_a_scan_waits_for_its_wheels() -> None:
    """The robot turned by 80 degrees while neither scans nor wheels came."""
    poses = way(40)
    poses[20:] = [compose(compose(poses[19], np.array((0.3, -0.2, -1.4))), between(poses[20], p)) for p in poses[20:]]
    pause_ns = 3 * 10**9
    records: list[LidarScan | WheelPose] = []
    for k, (scan, wheel) in enumerate(zip(scans(poses), wheels(poses), strict=True)):
        late = pause_ns if k >= 20 else 0
        records.append(LidarScan(scan.stamp_ns + late, *list(vars(scan).values())[1:]))
        records.append(WheelPose(wheel.stamp_ns + late, wheel.pose_xyyaw))  # behind its scan
    steps = fed(MixtureLidar(), records)
    assert steps[19].robot_odom_xyyaw == pytest.approx(wheels(poses)[20].pose_xyyaw)
    np.testing.assert_allclose(steps[19].relative_xyyaw, between(poses[19], poses[20]), atol=0.1)
    assert off(steps, poses) < 0.1


def test_wheels_that_restart_begin_a_new_frame() -> None:
    poses = way(60)
    records: list[LidarScan | WheelPose] = []
    for k, (scan, wheel) in enumerate(zip(scans(poses), wheels(poses), strict=True)):
        back = 0 if k < 30 else 5 * 10**9  # the wheels' clock jumps back, and they begin at zero
        pose = wheel.pose_xyyaw if k < 30 else between(wheels(poses)[30].pose_xyyaw, wheel.pose_xyyaw)
        records += [WheelPose(wheel.stamp_ns - back, pose), scan]
    steps = fed(MixtureLidar(), records)
    assert len(steps) == 59 and off(steps, poses) < 0.05


def test_stamps_that_came_already_and_restarts() -> None:
    poses = way(30)
    ours, odometry = scans(poses), MixtureLidar()
    fed(odometry, ours[:20], at_end=False)
    with pytest.raises(DuplicateFrame):
        odometry.add_scan(ours[19])
    with pytest.raises(LateFrame):
        odometry.add_scan(ours[15])
    assert odometry.restarts == 0
    again = fed(odometry, [scan_of(ours[0].ranges, -50), *(scan_of(scan.ranges, k - 50) for k, scan in
                enumerate(ours[1:], 1))])  # fmt: skip
    assert odometry.restarts == 1 and len(again) == 29
    assert again[0].origin_scan is not None and again[0].origin_stamp_ns == BEGIN_NS - 50 * STEP_NS
    np.testing.assert_array_equal(again[-1].odom_xyyaw, fed(MixtureLidar(), ours)[-1].odom_xyyaw)


def swept_scans(
    turns: list[float], room: np.ndarray = ROOM, angles: np.ndarray = ANGLES
) -> tuple[np.ndarray, list[LidarScan], list[LidarScan]]:
    """Poses of a robot that turns by so much (rad) from scan to scan, and scans that sweep for 0.09 s, which do not say
    it and which do."""
    sweep_s, rays = 0.09, len(angles)
    steps_xyyaw = [np.array((0.05 if turn else 0.0, 0.0, turn)) for turn in turns]
    poses = [np.array((1.5, 1.2, 0.6))]
    for step in steps_xyyaw:
        poses.append(compose(poses[-1], step))
    offsets = np.arange(rays) * sweep_s / rays
    noise, plain, swept = np.random.default_rng(0), [], []
    for k, (pose, step) in enumerate(zip(poses, steps_xyyaw, strict=False)):
        moved = [compose(pose, step * t / 0.1) for t in offsets]
        ranges = np.array([cast(room, at, angle[None])[0] for at, angle in zip(moved, angles, strict=True)])
        ranges += noise.normal(0.0, 0.005, rays)
        plain.append(scan_of(ranges, k, angles))
        swept.append(scan_of(ranges, k, angles, time_increment=sweep_s / rays))
    return np.array(poses), plain, swept


def test_deskew_helps_a_robot_that_turns() -> None:
    """It turns to and fro, after it stood."""
    poses, plain, swept = swept_scans([0.0] * 5 + [math.radians(8.0 if k // 8 % 2 else -8.0) for k in range(24)])
    found = []
    for each in (plain, swept):
        records = [record for pair in zip(wheels(poses), each, strict=False) for record in pair]
        steps = fed(MixtureLidar(), records)
        errors = [between(between(poses[0], p), step.odom_xyyaw) for p, step in zip(poses[1:], steps, strict=False)]
        found.append(float(np.sqrt(np.mean(np.square(errors)[:, :2].sum(1)))))
    assert found[1] < 0.1 * found[0]


def test_the_first_scan_is_deskewed_by_the_wheels() -> None:
    """Else its bend, of half a sweep's turn, stays in the path."""
    poses, _, swept = swept_scans([math.radians(8.0)] * 12)
    steps = fed(MixtureLidar(), [record for pair in zip(wheels(poses), swept, strict=False) for record in pair])
    errors = [between(between(poses[0], p), step.odom_xyyaw) for p, step in zip(poses[1:], steps, strict=False)]
    assert len(steps) == 11 and np.abs(errors).max() < 0.01


def errors_of_slipping_wheels(poses: np.ndarray, scans: list[LidarScan], slips_rad: list[float]) -> np.ndarray:
    """Errors ``(steps, 3)`` of the poses that scans get whose wheels turn by so much more from each to the next."""
    slipped = [poses[0]]
    for before, after, slip in zip(poses[:-1], poses[1:], slips_rad, strict=True):
        slipped.append(compose(slipped[-1], between(before, after) + (0.0, 0.0, slip)))
    records = [record for pair in zip(wheels(np.array(slipped)), scans, strict=False) for record in pair]
    found = fed(MixtureLidar(), records)
    assert not any(step.unsure for step in found)
    return np.array([
        between(between(poses[0], pose), step.odom_xyyaw) for pose, step in zip(poses[1:], found, strict=False)
    ])  # fmt: skip


def test_wheels_that_slip_bend_no_scan() -> None:
    """A wheel slips in bursts, which turns the wheels by up to 4 degrees a sweep that the robot does not turn."""
    poses, _, swept = swept_scans([0.0] * 5 + [math.radians(3.0 if k // 8 % 2 else -3.0) for k in range(64)])
    slips = [math.radians(4.0 * (-1) ** (k // 24)) if 15 < k % 24 < 21 else 0.0 for k in range(len(poses) - 1)]
    errors = errors_of_slipping_wheels(poses, swept, slips)
    assert np.abs(errors[:, 2]).max() < 0.01
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.02


@pytest.mark.parametrize("slip_deg", [-8.0, 12.0])
def test_wheels_that_slip_so_fast_that_a_scan_fits_nowhere(slip_deg: float) -> None:
    """In a hall, wheels that slip for half a second bend scans of far walls, which then fit nowhere near where the
    wheels lead. By the velocity that the robot had before they are straight."""
    turns = [math.radians(math.sin(0.2 * k)) for k in range(1, 60)]
    poses, _, swept = swept_scans(turns, 3.0 * ROOM, fan(481, 340.0))
    slips = [math.radians(slip_deg) if 20 <= k % 30 < 25 else 0.0 for k in range(len(poses) - 1)]
    errors = errors_of_slipping_wheels(poses, swept, slips)
    assert np.abs(errors[:, 2]).max() < 0.02
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.1


@pytest.mark.parametrize("step_m", [0.003, 0.01, 0.05])
def test_wheels_that_stand_do_not_hold_a_robot_that_drives(step_m: float) -> None:
    poses = np.array([compose(way(1)[0], np.array((max(0, k - 10) * step_m, 0.0, 0.0))) for k in range(70)])
    stood = wheels(np.tile(poses[0], (70, 1)))
    found = fed(MixtureLidar(), [record for pair in zip(stood, scans(poses), strict=True) for record in pair])
    errors = [between(between(poses[0], p), step.odom_xyyaw) for p, step in zip(poses[1:], found, strict=True)]
    assert np.abs(errors).max() < 0.02


def hostile_scans() -> dict[str, LidarScan]:
    count = 20_000
    good = cast(ROOM, way(20)[10], ANGLES)
    return {
        "tiny increment": scan_of(good, 0, np.array((0.0, 1e-9))),
        "all nan": scan_of(np.full(241, np.nan), 0),
        "all inf": scan_of(np.full(241, np.inf), 0),
        "all zero": scan_of(np.zeros(241), 0),
        "all negative": scan_of(np.full(241, -3.0), 0),
        "one ray": scan_of(np.ones(1), 0, np.zeros(1)),
        "no ray": scan_of(np.zeros(0), 0, np.zeros(1)),
        "20,000 rays": scan_of(np.full(count, 3.0), 0, np.linspace(-3.0, 3.0, count)),
        "20,000 wild rays": scan_of(np.random.default_rng(0).uniform(0.0, 900.0, count), 0, np.linspace(-3, 3, count)),
        "too many rays": scan_of(np.ones(count + 1), 0, np.linspace(-3.0, 3.0, count + 1)),
        "clockwise": scan_of(good[::-1], 0, ANGLES[::-1]),
        "no range_max": scan_of(good, 0, range_max=0.0),
        "infinite range_max": scan_of(good, 0, range_max=math.inf),
        "range_max of nan": scan_of(good, 0, range_max=math.nan),
        "limits in the wrong order": scan_of(good, 0, range_min=50.0, range_max=1.0),
        "everything far away": scan_of(np.full(241, 3e38), 0, range_max=math.inf),
        "all in one place": scan_of(np.full(241, 0.0500001), 0),
        "a sweep of hours": scan_of(good, 0, time_increment=100.0),
        "a sweep of nan": scan_of(good, 0, time_increment=math.nan),
    }


@pytest.mark.parametrize("name", hostile_scans())
def test_a_hostile_scan_costs_itself_alone(name: str) -> None:
    """In the middle of a drive, and as its first scan; no message takes long."""
    poses = way(20)
    bad = hostile_scans()[name]
    for at in (0, 10):
        odometry, steps, refused = MixtureLidar(), [], 0
        for k, scan in enumerate(scans(poses)):
            one = LidarScan(scan.stamp_ns, *list(vars(bad).values())[1:]) if k == at else scan
            began = time.process_time()
            try:
                odometry.add_scan(one)
                steps += list(odometry.ready())
            except UnusableImage:
                refused += 1
            assert time.process_time() - began < 2.0 or k < 2  # the first ones compile
        assert refused <= 1 and len(steps) >= 18
        for step in steps:
            check_step(step, 0, None)
            assert step.odom_xyyaw.dtype == np.float64
        assert at == 0 or off(steps, poses) < 0.1


values = st.sampled_from([0.0, 1e9, 1e-3, 1.0, -1.0, 1e6, 1e150, 1e300, -1e300, math.nan, math.inf])


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 30), st.integers(-40, 40), st.tuples(values, values, values)), max_size=8))
@example([(0, 0, (0.0, 0.0, 0.0)), (0, 0, (0.0, 0.0, 0.0)), (4, 14, (0.0, 1e9, 0.0)), (12, -23, (0.0, 0.0, 0.0))])
def test_any_wheels_leave_finite_steps(hostile: list[tuple[int, int, tuple[float, ...]]]) -> None:
    poses = way(31)
    odometry, steps = MixtureLidar(), []
    for k, (scan, wheel) in enumerate(zip(scans(poses), wheels(poses), strict=True)):
        odometry.add_wheels(wheel.stamp_ns, wheel.pose_xyyaw)
        for at, late, pose in hostile:
            if at == k:
                try:
                    odometry.add_wheels(wheel.stamp_ns + late * 50_000_000, np.array(pose))
                except ValueError:
                    assert not (np.abs(pose) <= 1e9).all()
        odometry.add_scan(scan)
        steps += list(odometry.ready())
    steps += list(odometry.ready(at_end=True))
    assert len(steps) == 30
    for step in steps:
        check_step(step, 0, None)


def test_silent_wheels_leave_the_detector_at_work() -> None:
    """Where wheels fall silent, ranges tell at once whether the robot stands."""
    poses = np.concatenate((way(20, 0.0), np.tile(way(20, 0.0)[-1], (60, 1))))
    odometry = MixtureLidar()
    steps = fed(odometry, sorted([*scans(poses), *wheels(poses)[:20]], key=lambda each: each.stamp_ns))
    assert len(steps) == 79
    assert np.abs(steps[-1].odom_xyyaw - steps[30].odom_xyyaw).max() < 0.03
