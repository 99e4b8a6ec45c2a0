"""Logs of sensors, and changes of them."""

from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from training.data.lidar_changes import CHANGES, OF_WHEELS, UNSEEDED, changed
from training.data.lidar_drives import LidarDrive, Relations, TruePoses
from training.data.sensor_log import FAR_AWAY_M, SensorLog

S = 1_000_000_000
SCANS, RAYS = 3000, 80  # 0.1 s apart
TAKEN = S + S // 10 * np.arange(SCANS)
POSES = np.stack((0.05 * np.arange(SCANS), np.zeros(SCANS), 0.02 * np.sin(np.arange(SCANS) / 50.0)), axis=-1)


def log() -> SensorLog:
    """Straight ahead at 0.5 m/s with a wiggle; walls at 2 to 10 m, and the last ray never returns."""
    ranges = np.tile(np.linspace(2.0, 10.0, RAYS, dtype=np.float32), (SCANS, 1))
    ranges[:, -1] = np.inf
    scanner = LidarScan(S, -1.0, 0.025, ranges[0], 0.1, 30.0, 0.0, "laser")
    return SensorLog(TAKEN, TAKEN, ranges, TAKEN, POSES, Mounting(np.zeros(3)), scanner, POSES)


def seen(log: SensorLog) -> list[np.ndarray]:
    return [log.stamps_ns, log.ranges, log.wheel_stamps_ns, log.wheel_poses, log.mounting.sensor_xyyaw]


def gaps_s(stamps_ns: np.ndarray) -> np.ndarray:
    """Longer gaps than from one reading to the next."""
    between = np.diff(stamps_ns) / S
    return between[between > 0.15]


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_follows_from_its_seed_and_leaves_the_log_it_was_given(name: str) -> None:
    before, again = log(), log()
    one, same, other = (changed(before, name, seed) for seed in (3, 3, 4))
    assert all(map(np.array_equal, seen(one), seen(same)))
    assert all(map(np.array_equal, seen(one), seen(other))) == (name in UNSEEDED)
    assert all(map(np.array_equal, seen(before), seen(again)))
    assert (np.diff(one.stamps_ns) > 0).all() and (np.diff(one.wheel_stamps_ns) > 0).all()


@pytest.mark.parametrize("name", CHANGES)
def test_truth_stays_with_the_scan(name: str) -> None:
    after = changed(log(), name, 0)
    index = np.searchsorted(TAKEN, after.taken_ns)
    np.testing.assert_array_equal(TAKEN[index], after.taken_ns)
    np.testing.assert_array_equal(POSES[index], after.true_poses)


@pytest.mark.parametrize("name", sorted(OF_WHEELS))
def test_changes_of_wheels_leave_the_scans(name: str) -> None:
    before, after = seen(log()), seen(changed(log(), name, 0))
    assert [np.array_equal(*pair) for pair in zip(before, after, strict=True)][:2] == [True, True]
    assert not (np.array_equal(before[2], after[2]) and np.array_equal(before[3], after[3]))


def test_clean_is_the_log() -> None:
    assert all(map(np.array_equal, seen(log()), seen(changed(log(), "clean", 0))))


def test_bunches_arrive_late_and_a_millisecond_apart() -> None:
    after = changed(log(), "scans_bunched", 0)
    late_s = (after.stamps_ns - after.taken_ns) / S
    late = late_s > 1e-4
    assert late_s.min() >= 0.0 and 1.5 < late_s.max() < 1.8
    assert 0.15 < late.mean() < 0.4  # bunches are half of the stretches, and the shorter ones
    apart = np.diff(after.stamps_ns)[late[1:] & late[:-1]]
    assert np.isclose(apart, 1_000_000, atol=10).mean() > 0.7
    assert len(after.wheel_stamps_ns) == SCANS and np.array_equal(after.wheel_stamps_ns, TAKEN)
    assert np.max(changed(log(), "both_bunched_short", 0).stamps_ns - TAKEN) < 0.6 * S


def test_both_bunch_each_on_its_own() -> None:
    after = changed(log(), "both_bunched", 0)
    assert not np.array_equal(after.stamps_ns, after.wheel_stamps_ns)
    assert np.array_equal(after.stamps_ns, changed(log(), "scans_bunched", 0).stamps_ns)


def test_jitter_has_its_deviation() -> None:
    off_s = (changed(log(), "stamps_jitter", 0).stamps_ns - TAKEN) / S
    assert off_s.std() == pytest.approx(0.03, rel=0.05)


def test_scans_are_lost() -> None:
    assert len(changed(log(), "one_scan_in_ten", 0).stamps_ns) == pytest.approx(SCANS / 10, rel=0.15)
    paused = changed(log(), "no_scans_for_10s", 0)
    assert gaps_s(paused.stamps_ns).max() >= 10.0
    assert 10.0 < gaps_s(paused.stamps_ns).sum() <= 81.0
    assert np.array_equal(paused.wheel_poses, POSES)


def test_wheels_fall_silent() -> None:
    after = changed(log(), "wheels_silent_for_10s", 0)
    assert gaps_s(after.wheel_stamps_ns).max() >= 10.0
    np.testing.assert_array_equal(after.wheel_poses[-1], POSES[-1])


def test_who_is_carried_is_elsewhere_and_the_wheels_do_not_know() -> None:
    after = changed(log(), "carried_while_paused", 0)
    paused = np.flatnonzero(np.diff(after.stamps_ns) > 0.15 * S)
    assert np.array_equal(after.stamps_ns, after.wheel_stamps_ns)
    assert gaps_s(after.stamps_ns).max() >= 20.0 and 1 <= len(paused) <= 3
    moved = np.hypot(*np.diff(after.wheel_poses[:, :2], axis=0).T)
    np.testing.assert_allclose(moved[paused], 0.0)
    np.testing.assert_allclose(np.delete(moved, paused), 0.05, atol=1e-9)
    assert after.true_poses is not None
    assert np.diff(after.true_poses[:, 0])[paused].min() > 9.9


def test_wheels_lose_spin_and_begin_anew() -> None:
    way = POSES[-1, 0]
    lost = changed(log(), "wheels_lose_5s", 0)
    still = np.hypot(*np.diff(lost.wheel_poses[:, :2], axis=0).T) < 1e-9
    assert 49 <= still.sum() <= 8 * 50
    spun = changed(log(), "wheels_spin", 0)
    lengths = np.hypot(*np.diff(spun.wheel_poses[:, :2], axis=0).T)
    assert lengths.sum() == pytest.approx(way + 8.0, abs=0.01)
    anew = changed(log(), "wheels_begin_anew", 0)
    zeros = np.flatnonzero(~anew.wheel_poses.any(axis=1))
    assert len(zeros) == 6  # the start, and five more
    np.testing.assert_allclose(anew.wheel_poses[zeros[-1] + 1 :, 0].max(), way - POSES[zeros[-1], 0], rtol=0.01)


def test_wheels_count_too_little_and_turn_the_wrong_way() -> None:
    assert changed(log(), "wheels_scale_80", 0).wheel_poses[-1, 0] == pytest.approx(0.8 * POSES[-1, 0], rel=1e-3)
    turned = changed(log(), "wheels_turn_wrong_way", 0).wheel_poses
    np.testing.assert_allclose(turned[:, 2], -POSES[:, 2], atol=1e-9)


def test_the_scanner_sees_less() -> None:
    ranges = log().ranges
    near = changed(log(), "range_5m", 0).ranges
    assert np.array_equal(np.isfinite(near), ranges <= 5.0)
    half = changed(log(), "half_covered", 0).ranges
    assert not np.isfinite(half[:, : RAYS // 2]).any() and np.array_equal(half[:, RAYS // 2 :], ranges[:, RAYS // 2 :])
    lost = changed(log(), "rays_lost", 0).ranges
    assert (lost == 0.0).mean() == pytest.approx(0.4, abs=0.01)
    assert np.array_equal(lost[lost != 0.0], ranges[lost != 0.0])


def test_a_quarter_of_the_rays_look_where_they_did() -> None:
    before = log()
    after = changed(before, "quarter_of_rays", 0)
    assert after.ranges.shape == (SCANS, RAYS // 4)
    np.testing.assert_array_equal(after.ranges[:, 5], before.ranges[:, 20])
    assert after.scanner.angle_increment == pytest.approx(4 * 0.025)


def test_noise_makes_no_returns() -> None:
    off = changed(log(), "noise_5cm", 0).ranges[:, :-1] - log().ranges[:, :-1]
    assert off.std() == pytest.approx(0.05, rel=0.02)
    assert np.isinf(changed(log(), "noise_5cm", 0).ranges[:, -1]).all()


@pytest.mark.parametrize("no_return", [np.inf, 30.1, 0.0])
def test_people_stand_before_the_walls_and_where_nothing_returned(no_return: float) -> None:
    before = log()
    ranges = before.ranges.copy()
    ranges[:, -10:] = no_return
    after = changed(replace(before, ranges=ranges), "people", 0).ranges
    there = after != ranges
    assert (after[there] >= 0.5 - 1e-6).all() and (after[there] <= 1.5 + 1e-6).all()
    assert 0.1 < there.mean() < 8 / 20
    assert there[:, -10:].any()
    walking = there[1:] != there[:-1]
    assert 0.0 < walking.mean() < 0.2


def test_the_mounting_is_off() -> None:
    np.testing.assert_allclose(changed(log(), "mounted_3_deg_off", 0).mounting.sensor_xyyaw, (0, 0, np.radians(3.0)))


def test_wrong_names_and_short_drives_are_refused() -> None:
    with pytest.raises(ValueError, match="expected one of clean, "):
        changed(log(), "wheels_square", 0)
    brief = log().keep_wheels(TAKEN < 60 * S)
    with pytest.raises(ValueError, match="wheels move at 0 readings"):
        changed(brief, "wheels_spin", 0)


STAMPS = [10, 20, 30, 25, 30, 40]
WAY = np.stack((np.arange(6.0), np.zeros(6), np.zeros(6)), axis=-1)


def drive(reference: TruePoses | Relations | None) -> LidarDrive:
    scans = tuple(LidarScan(t, 0.0, 0.1, np.full(5, t, np.float32), 0.0, 50.0, 0.0, "laser") for t in STAMPS)
    wheels = tuple(map(WheelPose, STAMPS, WAY))
    return LidarDrive("one", "one", scans, wheels, Mounting(np.zeros(3)), reference)


def test_what_is_no_newer_than_before_is_left_out() -> None:
    log = SensorLog.of_drive(drive(TruePoses(np.array(STAMPS), WAY)))
    assert log.stamps_ns.tolist() == log.taken_ns.tolist() == log.wheel_stamps_ns.tolist() == [10, 20, 30, 40]
    assert log.ranges[:, 0].tolist() == [10, 20, 30, 40]
    assert log.true_poses is not None
    assert log.true_poses[:, 0].tolist() == log.wheel_poses[:, 0].tolist() == [0, 1, 2, 5]


def test_a_drive_is_that_of_its_log_with_the_truth_at_the_stamps_as_given() -> None:
    log = SensorLog.of_drive(drive(TruePoses(np.array(STAMPS), WAY)))
    late = replace(log, stamps_ns=log.stamps_ns + 5).drive("late", "why")
    assert late.scan_stamps_ns.tolist() == [15, 25, 35, 45]
    assert [pose.stamp_ns for pose in late.wheels] == [10, 20, 30, 40]
    assert isinstance(late.reference, TruePoses)
    assert late.reference.stamps_ns.tolist() == [15, 25, 35, 45]
    relations = Relations(np.zeros((0, 2)), np.zeros((0, 3)))
    assert SensorLog.of_drive(drive(relations)).drive("a", "b", relations).reference is relations


def test_steps_of_the_wheels_make_their_poses() -> None:
    log = SensorLog.of_drive(drive(None))
    turned = replace(log, wheel_poses=np.array([(1, 2, 0.5), (2, 2, 1.5), (2, 3, 3.0), (0, 0, -3.0)]))
    np.testing.assert_allclose(turned.with_wheel_steps(turned.wheel_steps).wheel_poses, turned.wheel_poses, atol=1e-12)


def test_scanners_that_change_and_truth_of_other_stamps_are_refused() -> None:
    other = drive(None)
    with pytest.raises(ValueError, match="all with the same rays"):
        SensorLog.of_drive(replace(other, scans=(other.scans[0], replace(other.scans[1], angle_min=1.0))))
    with pytest.raises(ValueError, match="other stamps"):
        SensorLog.of_drive(drive(TruePoses(np.arange(6), WAY)))


def test_logs_that_are_put_together_go_on_elsewhere() -> None:
    log = SensorLog.of_drive(drive(TruePoses(np.array(STAMPS), WAY)))
    turned = replace(log, wheel_poses=log.wheel_poses + (0.0, 7.0, 0.0))
    both = log.followed_by(turned, 1e-7)
    assert both.stamps_ns.tolist() == both.wheel_stamps_ns.tolist() == [10, 20, 30, 40, 140, 150, 160, 170]
    assert both.wheel_poses[:, 0].tolist() == [0, 1, 2, 5, 5, 6, 7, 10]
    assert not both.wheel_poses[:, 1:].any()
    assert both.true_poses is not None
    assert both.true_poses[4:, 0].tolist() == [FAR_AWAY_M + x for x in (0, 1, 2, 5)]
    here = log.followed_by(turned, 1e-7, 0.0).true_poses
    assert here is not None and here[4:, 0].tolist() == [0, 1, 2, 5]
