"""What drivers of scanners and wheels say wrongly is noticed by itself, and sound ones are left as they are."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.frontend.intake.imu_turns import ImuTurns
from ngo_estimator.frontend.intake.no_return import NoReturnValues
from ngo_estimator.frontend.intake.scanner import Scanner
from ngo_estimator.frontend.intake.single_wheels import SingleWheels
from ngo_estimator.frontend.intake.turns import Part, together
from ngo_estimator.frontend.intake.wheel_clock import CorrectedWheels, WheelTruth
from ngo_estimator.geometry.planar_motion import Array, between, compose
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from tests.unit.ngo_estimator.ray_casting import ROOM, cast

RAYS = 360
STEP = np.array((0.1, 0.0, 0.03))
NO_RETURN_M = 3.2


def drive(count: int = 60, noise_m: float = 0.005) -> list[LidarScan]:
    noise, pose, scans = np.random.default_rng(0), np.array((1.0, 1.0, 0.2)), []
    angles = np.linspace(-math.pi, math.pi, RAYS, endpoint=False)
    for k in range(count):
        ranges = (cast(ROOM, pose, angles) + noise.normal(0.0, noise_m, RAYS)).astype(np.float32)
        scans.append(LidarScan(k * 10**8, -math.pi, math.tau / RAYS, ranges, 0.05, 30.0, 0.1 / RAYS, "laser"))
        pose = compose(pose, STEP)
    return scans


@pytest.mark.parametrize("jitter_m", [0.0, 0.004])
@pytest.mark.parametrize("beyond", [False, True])
def test_a_value_that_means_no_return_may_jitter(jitter_m: float, beyond: bool) -> None:
    noise, found = np.random.default_rng(1), NoReturnValues()
    for scan in drive():
        far = scan.ranges > NO_RETURN_M
        ranges = np.where(far, NO_RETURN_M + jitter_m * noise.standard_normal(RAYS), scan.ranges).astype(np.float32)
        if beyond:  # a few walls there are seen
            ranges[np.flatnonzero(far)[:2]] = 7.0
        clean = found.clean(replace(scan, ranges=ranges))
        found.moved(STEP)
    assert found.values == pytest.approx([NO_RETURN_M], abs=1e-6)
    usable = clean.ranges < clean.range_max  # not a number is not
    assert far.sum() > 20 and (usable & far).sum() == 2 * beyond
    assert (usable & (scan.ranges < NO_RETURN_M - 0.05)).sum() == (scan.ranges < NO_RETURN_M - 0.05).sum()


def test_what_stands_in_the_room_is_no_value_of_no_return() -> None:
    """Also where the robot turns beside it on the spot, where it drives past, and where it sees itself."""
    found, turning, itself = NoReturnValues(), NoReturnValues(), NoReturnValues()
    for k, scan in enumerate(drive()):
        ranges = scan.ranges.copy()
        ranges[np.arange(20) + 5 * k] = 1.2 + 0.001 * np.arange(20)
        turning.clean(replace(scan, ranges=ranges))
        turning.moved(np.array((0.0, 0.0, 0.1)))
        beside = math.hypot(1.2, 0.1 * (k - 30))
        ranges[np.arange(20) + 5 * k] = beside + 0.001 * np.arange(20)
        found.clean(replace(scan, ranges=ranges))
        found.moved(STEP)
        ranges = scan.ranges.copy()
        ranges[:20] = 0.4 + 0.001 * np.arange(20)
        itself.clean(replace(scan, ranges=ranges))
        itself.moved(STEP)
    assert found.values == [] and turning.values == [] and itself.values == []


@pytest.mark.parametrize(
    ("limit_m", "unit", "least_m"), [(30.0, 1.0, 0.05), (30_000.0, 0.001, 50.0), (0.0, 1.0, 0.05), (0.0, 0.001, 50.0)]
)
def test_ranges_in_millimetres_are_told_and_scaled(limit_m: float, unit: float, least_m: float) -> None:
    scanner = Scanner()
    for scan in drive(10):
        wrong = replace(scan, ranges=np.round(scan.ranges * 1000.0), range_max=limit_m, range_min=least_m)
        found = scanner.correct(wrong, 0.0)
    assert found is not None
    np.testing.assert_allclose(found.ranges, scan.ranges, atol=0.001)
    assert found.range_max == pytest.approx(limit_m * unit) and found.range_min == pytest.approx(0.05)
    assert scanner.remarks("laser") == ["laser: its ranges are in millimetres: taken so"]


@pytest.mark.parametrize("limits_m", [(5.0, 3000.0), (0.05, 30.0)])
def test_ranges_in_centimetres_are_told_and_scaled(limits_m: tuple[float, float]) -> None:
    scanner = Scanner()
    for scan in drive(10):
        wrong = replace(scan, ranges=np.round(100.0 * scan.ranges), range_min=limits_m[0], range_max=limits_m[1])
        found = scanner.correct(wrong, 0.0)
    assert found is not None and (found.range_min, found.range_max) == (0.05, 30.0)
    np.testing.assert_allclose(found.ranges, scan.ranges, atol=0.01)
    assert scanner.remarks("laser") == ["laser: its ranges are in centimetres: taken so"]


@pytest.mark.parametrize("limits_m", [(0.1, math.inf), (0.1, 1000.0), (0.05, 1000.0), (1.5, 300.0), (2.0, 250.0)])
def test_a_field_is_in_metres_whatever_the_limits(limits_m: tuple[float, float]) -> None:
    noise, scanner = np.random.default_rng(0), Scanner()
    for scan in drive(10):
        wide = (120.0 + 100.0 * np.sin(5.0 * scan.angles) + noise.normal(0.0, 0.02, RAYS)).astype(np.float32)
        found = scanner.correct(replace(scan, ranges=wide, range_min=limits_m[0], range_max=limits_m[1]), 0.0)
    assert found is not None and np.array_equal(found.ranges, wide) and not scanner.remarks("laser")


@pytest.mark.parametrize("limits_m", [(100.0, 120.0), (50.0, 12_000.0), (15.0, 0.0), (0.1, 0.5)])
def test_limits_that_contradict_all_ranges_are_told_and_not_used(limits_m: tuple[float, float]) -> None:
    scanner = Scanner()
    for scan in drive(10):
        found = scanner.correct(replace(scan, range_min=limits_m[0], range_max=limits_m[1]), 0.0)
    assert found is not None and len(found.hits()) == len(scan.hits())
    assert scanner.remarks("laser") == ["laser: nearly all it measures is beyond its limits: they are not used"]


@pytest.mark.parametrize(("share", "limit_m"), [(0.6, 60.0), (0.95, 60.0), (0.0, 2.0)])
def test_limits_count_where_nothing_comes_back_or_much_is_within_them(share: float, limit_m: float) -> None:
    """Where nothing comes back the driver says 65 to 66 m; without these, most of the room is beyond the limit."""
    noise, scanner = np.random.default_rng(1), Scanner()
    for scan in drive(10):
        ranges = np.where(noise.random(RAYS) < share, noise.uniform(65.0, 66.0, RAYS), scan.ranges).astype(np.float32)
        found = scanner.correct(replace(scan, ranges=ranges, range_max=limit_m), 0.0)
        assert found is not None and 0.0 < found.range_max <= limit_m
    told = [] if share else ["laser: most of what it measures is beyond its range_max: not used"]
    assert (scan.ranges > 2.0).mean() > 0.5 and scanner.remarks("laser") == told


def test_what_is_said_of_a_scan_is_told_once() -> None:
    scanner = Scanner()
    for scan in drive(3):
        scanner.correct(replace(scan, note="its distances are in millimetres: taken so"), 0.0)
    assert scanner.remarks("points") == ["points: its distances are in millimetres: taken so"]


def test_limits_that_are_not_used_stay_so_and_one_scan_is_not_enough() -> None:
    scanner, once = Scanner(), Scanner()
    for k, scan in enumerate(drive(10)):
        found = scanner.correct(replace(scan, range_max=0.5 if k < 5 else 30.0), 0.0)
        alone = once.correct(replace(scan, range_max=0.5 if k % 3 else 30.0), 0.0)
        assert alone is not None and alone.range_max > 0.0
    assert found is not None and found.range_max == 0.0 and once.remarks("laser") == []


def test_a_driver_that_begins_with_ranges_far_away_is_in_metres_again() -> None:
    scanner, scans = Scanner(), drive(20)
    for scan in scans[:5]:
        scanner.correct(replace(scan, ranges=1000.0 * scan.ranges), 0.0)
    assert scanner.remarks("laser")
    for scan in scans[5:]:
        found = scanner.correct(scan, 0.0)
    assert found is not None and np.array_equal(found.ranges, scan.ranges) and not scanner.remarks("laser")


def test_ranges_far_away_and_codes_for_no_return_are_metres() -> None:
    far, coded = Scanner(), Scanner()
    for scan in drive(10):
        code = np.full(RAYS, 65_535.0, np.float32)
        code[::12] = scan.ranges[::12]
        for scanner, ranges in ((coded, code), (far, 30.0 * scan.ranges)):
            found = scanner.correct(replace(scan, ranges=ranges, range_max=0.0), 0.0)
            assert found is not None and np.array_equal(found.ranges, ranges)
    assert not any("millimetres" in line for line in (*far.remarks("laser"), *coded.remarks("laser")))


@pytest.mark.parametrize("late_ns", [1_000_000, 50_000_000])
def test_a_scan_that_is_published_again_is_left_out(late_ns: int) -> None:
    scanner = Scanner()
    scans = drive(20)
    kept = [
        found
        for scan in scans
        for again in (scan, replace(scan, stamp_ns=scan.stamp_ns + late_ns))
        if (found := scanner.correct(again, 0.0)) is not None
    ]
    assert [scan.stamp_ns for scan in kept[-19:]] == [scan.stamp_ns for scan in scans[1:]]
    assert "scans are the one before once more" in scanner.remarks("laser")[0]


@pytest.mark.parametrize(
    ("way", "sees", "counted"), [(0.08, True, 4), (0.0, True, 99), (0.08, False, 99), (0.005, True, 99)]
)
def test_a_scanner_that_froze_repeats_its_scan_while_the_wheels_drive(way: float, sees: bool, counted: int) -> None:
    """A robot that stands, creeps, or sees nothing, sees the same."""
    scanner, (scan, other) = Scanner(), drive(2)
    scan = scan if sees else replace(scan, ranges=np.full(RAYS, np.inf, np.float32))
    kept = 0
    for k in range(99):
        driven = lambda from_ns, now=k: np.array((way * (now - from_ns / 10**8), 0.0, 0.0))  # noqa: E731
        kept += scanner.correct(replace(scan, stamp_ns=k * 10**8), 0.0, driven) is not None
    assert kept == counted
    assert any("while the wheels drive" in line for line in scanner.remarks("laser")) == (counted < 99)
    assert scanner.correct(replace(other, stamp_ns=99 * 10**8), 0.0, driven) is not None


def test_a_simulated_robot_that_stands_sees_the_same_at_its_usual_pace() -> None:
    """Also where it stood from the beginning, and something moved once."""
    scans = drive(10, noise_m=0.0)
    standing = [replace(scans[-1], stamp_ns=scans[-1].stamp_ns + k * 10**8) for k in range(1, 20)]
    since = [replace(scans[0], stamp_ns=scan.stamp_ns + 2 * 10**9) for scan in standing]
    for seen in ([*scans, *standing], [*standing, *since]):
        scanner = Scanner()
        assert all(scanner.correct(scan, 0.0) is not None for scan in seen)
        assert scanner.remarks("laser") == []


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_sectors_that_carry_one_stamp_were_measured_one_after_the_other(direction: float) -> None:
    """As many rays make a turn as do for the driver, though its increment is a short number."""
    (scan,) = drive(1)
    increment = float(np.nextafter(np.float32(scan.angle_increment), np.float32(0.0)))
    scan = replace(scan, angle_min=-direction * math.pi, angle_increment=direction * increment)
    mounting, third = Mounting(np.zeros(3)), RAYS // 3
    sectors = [
        replace(scan, angle_min=scan.angles[first], ranges=scan.ranges[first : first + third])
        for first in range(0, RAYS, third)
    ]
    parts = [Part(sector, mounting, "laser") for sector in sectors]
    whole = together(parts, parts[0])
    if direction < 0.0:  # a turn counts its rays counter-clockwise
        expected = np.roll(scan.ray_offsets_s[::-1], 1)
    else:
        expected = scan.ray_offsets_s
    np.testing.assert_allclose(whole.ray_offsets_s, expected, atol=1e-9)


def test_wheels_whose_pose_stays_while_the_robot_drives_tell_nothing() -> None:
    wheels, pose = CorrectedWheels(ImuTurns()), np.zeros(3)

    def second(at_s: int, step: Array) -> None:
        nonlocal pose
        pose = compose(pose, step)
        wheels.add(at_s * 10**9, pose, WheelTruth())
        wheels.moved(np.array((0.2, 0.0, 0.0)), 1e-4 * np.eye(3))

    for k in range(3):
        second(k, np.array((0.2, 0.0, 0.0)))
    for k in range(3, 8):
        second(k, np.zeros(3))
    assert wheels.frozen and wheels.froze
    assert wheels.motion(6 * 10**9, 7 * 10**9) is None and wheels.turn(6 * 10**9, 7 * 10**9) is None
    said = wheels.said(7 * 10**9)
    assert said is not None and np.array_equal(said, pose)
    second(8, np.array((1.2, 0.0, 0.0)))  # they catch up
    motion = wheels.motion(7 * 10**9, 8 * 10**9)
    assert not wheels.frozen and motion is not None
    np.testing.assert_allclose(motion, between(np.zeros(3), np.array((1.2, 0.0, 0.0))))


@pytest.mark.parametrize(("drift_m", "variance"), [(0.0, 1e-4), (0.02, 1e-4), (0.2, 0.1)])
def test_wheels_of_a_robot_that_stands_count(drift_m: float, variance: float) -> None:
    """Also where scans drift by and by, and in a corridor, where they do not know how far."""
    wheels = CorrectedWheels(ImuTurns())
    for k in range(60):
        wheels.add(k * 10**9, np.zeros(3), WheelTruth())
        wheels.moved(np.array((0.004 * (-1) ** k + drift_m, 0.0, 0.0)), variance * np.eye(3))  # a match is never exact
        assert not wheels.froze
    assert not wheels.frozen and wheels.motion(10**9, 2 * 10**9) is not None


@pytest.mark.parametrize("missing", [0, 7])
def test_of_two_scanners_in_one_frame_the_first_counts(missing: int) -> None:
    """The other one looks back; some of its scans are lost."""
    scanner, scans, kept = Scanner(), drive(60), list[int]()
    for k, scan in enumerate(scans):
        back = replace(scan, stamp_ns=scan.stamp_ns + 20_000_000, ranges=np.roll(scan.ranges, RAYS // 2))
        for each in (scan, back) if not missing or k % missing else (scan,):
            if scanner.correct(each, 0.0) is not None:
                kept.append(each.stamp_ns)
    late = [stamp_ns for stamp_ns in kept if stamp_ns > scans[20].stamp_ns]
    of_front = {scan.stamp_ns for scan in scans}
    assert 35 <= len(late) <= 40 and of_front.issuperset(late)
    assert "are of another scanner in the same frame" in scanner.remarks("laser")[0]


def test_scans_of_one_scanner_all_count() -> None:
    """Also where its rays change in number, where the robot turns fast, and where a turn comes in two halves."""
    scanner, halves, half = Scanner(), Scanner(), RAYS // 2
    for scan in drive(40):
        for first in (0, half):
            part = replace(scan, angle_min=scan.angles[first], ranges=scan.ranges[first : first + half])
            assert halves.correct(part, 0.0) is not None
    for k, scan in enumerate(drive(60)):
        turned = replace(scan, ranges=np.roll(scan.ranges, 40 * k)[: RAYS - k % 2])
        assert scanner.correct(turned, 0.0) is not None


def test_halves_of_a_turn_in_one_frame_all_count() -> None:
    """Each is like the one before the last, and has no ray in common with the last."""
    scanner = Scanner()
    for k, scan in enumerate(drive(60)):
        seen = (np.abs(scan.angles) < 0.5 * math.pi) == bool(k % 2)
        assert scanner.correct(replace(scan, ranges=np.where(seen, scan.ranges, np.float32(np.inf))), 0.0) is not None


def test_all_scans_of_a_robot_that_sways_at_half_their_rate_count() -> None:
    scanner, noise, angles = Scanner(), np.random.default_rng(0), np.linspace(-math.pi, math.pi, RAYS, endpoint=False)
    for k in range(80):
        pose = compose(np.array((1.0, 1.0, 0.2)), np.array((0.02 * k, 0.0, 0.12 * (-1) ** k)))
        ranges = (cast(ROOM, pose, angles) + noise.normal(0.0, 0.005, RAYS)).astype(np.float32)
        scan = LidarScan(k * 10**8, -math.pi, math.tau / RAYS, ranges, 0.05, 30.0, 0.0, "laser")
        assert scanner.correct(scan, 0.0) is not None


def poses_of(offset: Array, count: int, begin: int = 0) -> list[WheelPose]:
    """Of an odometry that began elsewhere."""
    path = [np.array((0.1 * k, 0.02 * k, 0.01 * k)) for k in range(begin, begin + count)]
    return [WheelPose((begin + k) * 10**8, compose(offset, pose)) for k, pose in enumerate(path)]


def test_of_two_odometries_on_a_topic_the_first_counts() -> None:
    first, second, single = poses_of(np.zeros(3), 40), poses_of(np.array((5.0, 3.0, 1.0)), 40), SingleWheels()
    mixed = [each for pair in zip(first, second, strict=True) for each in pair]
    found = [kept for each in mixed for kept in single.add(each)]
    assert found == first and "of another odometry on the same topic" in single.remark()
    late = poses_of(np.array((5.0, 3.0, 1.0)), 40, begin=60)  # the first one ends
    assert [kept for each in late for kept in single.add(each)] == late


def test_of_two_odometries_that_begin_at_one_place_one_counts() -> None:
    """The other one says 5 % more, of the way or of turns."""
    for more in ((1.05, 1.05, 1.0), (1.0, 1.0, 1.05)):
        single, kept = SingleWheels(), list[WheelPose]()
        for k in range(400):
            pose = np.array((0.02 * k, 0.0, 0.01 * k))
            for scale, after_ns in (((1.0, 1.0, 1.0), 0), (more, 10**7)):
                kept += single.add(WheelPose(k * 4 * 10**7 + after_ns, pose * scale))
        late = [each for each in kept if each.stamp_ns > 8 * 10**9]
        assert len({each.stamp_ns % (4 * 10**7) for each in late}) == 1 and len(late) >= 199
        assert "of another odometry on the same topic" in single.remark()


@pytest.mark.parametrize("noise_m", [0.0, 0.005, 0.05])
def test_poses_of_one_odometry_all_count(noise_m: float) -> None:
    """While it stands, drives, turns and drives back, also where its poses jitter."""
    rng, single, speed = np.random.default_rng(0), SingleWheels(), np.repeat((0.0, 0.03, -0.03, 0.0), 100)
    path = np.stack((np.cumsum(speed), np.zeros(400), np.cumsum(np.roll(speed, 50))), axis=1)
    poses = [WheelPose(k * 2 * 10**7, pose) for k, pose in enumerate(path + noise_m * rng.standard_normal((400, 3)))]
    assert [kept for each in poses for kept in single.add(each)] == poses and single.remark() == ""


def test_an_odometry_that_begins_anew_goes_on() -> None:
    single, before, after = SingleWheels(), poses_of(np.zeros(3), 10), poses_of(np.array((5.0, 3.0, 1.0)), 10, begin=10)
    assert [kept for each in (*before, *after) for kept in single.add(each)] == [*before, *after]
    assert single.remark() == ""
    millimetres = [replace(each, pose_xyyaw=each.pose_xyyaw * (1000.0, 1000.0, 1.0)) for each in before]
    single = SingleWheels()
    assert [kept for each in millimetres for kept in single.add(each)] == millimetres[:-1], "the last one waits"
