"""The local estimator follows a robot through rooms of known walls, with wheels and without."""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.scan_odometry import ScanEstimate, ScanOdometry, ScanOdometryConfig
from ngo_estimator.frontend.lidar.swept_scan import SweptScan
from ngo_estimator.frontend.lidar.wheel_odometry import WheelOdometry
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import Array, between, compose
from ngo_estimator.geometry.scan_points import Mounting
from tests.unit.ngo_estimator.ray_casting import HALLWAY, ROOM, fan, round_trip, scan_at

STEP_NS = 10**8


def drive(scans: Iterable[KeyScan], wheels: Array | None = None) -> tuple[list[ScanEstimate], ScanOdometry]:
    """Estimates of scans, with the wheels' poses ``(n, 3)`` at their stamps."""
    odometry, turning = ScanOdometry(), None if wheels is None else WheelOdometry()
    estimates = []
    for i, scan in enumerate(scans):
        if wheels is not None and turning is not None:
            turning.add(scan.stamp_ns, wheels[i])
        estimates.append(odometry.update(SweptScan(scan), turning))
    return estimates, odometry


def scans_along(
    segments: Array, poses: Array, angles: Array, mounting: Mounting | None = None, noise_m: float = 0.01
) -> list[KeyScan]:
    noise = (noise_m, np.random.default_rng(7))
    return [scan_at(segments, pose, i * STEP_NS, angles, mounting, noise) for i, pose in enumerate(poses)]


def off(estimates: list[ScanEstimate], poses: Array) -> tuple[float, float]:
    """Largest errors of position (m) and heading (rad), seen from the first pose."""
    errors = np.array([between(between(poses[0], p), e.pose) for p, e in zip(poses, estimates, strict=True)])
    return float(np.hypot(errors[:, 0], errors[:, 1]).max()), float(np.abs(errors[:, 2]).max())


@pytest.mark.parametrize(
    ("rays", "degrees"), [(90, 180.0), (181, 180.0), (361, 180.0), (360, 360.0), (1080, 270.0), (3000, 360.0)]
)
def test_without_wheels_it_follows_a_robot(rays: int, degrees: float) -> None:
    poses = round_trip(60)
    estimates, _ = drive(scans_along(ROOM, poses, fan(rays, degrees)))
    position, heading = off(estimates, poses)
    assert position < 0.04 and heading < 0.015
    assert not any(estimate.unsure for estimate in estimates)


@pytest.mark.parametrize("mounting", [Mounting(np.array((0.3, 0.1, -0.7))), Mounting(np.array((0.1, -0.2, 0.4)), True)])
def test_the_base_is_followed_and_not_the_sensor(mounting: Mounting) -> None:
    poses = round_trip(60)
    estimates, _ = drive(scans_along(ROOM, poses, fan(241, 240.0), mounting))
    position, heading = off(estimates, poses)
    assert position < 0.04 and heading < 0.015


def test_negative_increments_and_holes() -> None:
    poses, generator = round_trip(60), np.random.default_rng(5)
    scans = []
    for i, pose in enumerate(poses):
        walls = ROOM if i % 7 else ROOM[:3]
        scans.append(scan_at(walls, pose, i * STEP_NS, fan(241, 240.0)[::-1], noise=(0.01, generator)))
    position, heading = off(drive(scans)[0], poses)
    assert position < 0.05 and heading < 0.02


@pytest.mark.parametrize(("degrees", "most"), [(360.0, 1), (180.0, 25)])
@pytest.mark.parametrize("with_wheels", [False, True])
def test_turning_on_the_spot_makes_no_key_scans_of_what_is_known(degrees: float, most: int, with_wheels: bool) -> None:
    """Four turns on the spot, then on: the first turn shows all there is."""
    turns = [np.array((2.0, 2.0, math.remainder(math.radians(6.0) * k, math.tau))) for k in range(241)]
    poses = np.array([*turns, *(np.array((2.0 + 0.1 * k, 2.0, 0.0)) for k in range(1, 11))])
    wheels = poses * (1.0, 1.0, 1.0) if with_wheels else None
    estimates, _ = drive(scans_along(ROOM, poses, fan(int(degrees), degrees)), wheels)
    assert sum(estimate.is_key for estimate in estimates[:241]) <= most
    assert any(estimate.is_key for estimate in estimates[241:])
    position, heading = off(estimates, poses)
    assert position < 0.03 and heading < 0.015
    assert all(math.sqrt(estimate.since_key_covariance[2, 2]) < math.radians(1.0) for estimate in estimates)


def test_fast_turns_are_searched() -> None:
    """Up to 25 degrees and 0.4 m a scan, from rest."""
    poses = round_trip(40, period=20)
    estimates, _ = drive(scans_along(ROOM, poses, fan(241, 240.0)))
    position, heading = off(estimates, poses)
    assert position < 0.05 and heading < 0.03
    assert any(estimate.searched for estimate in estimates)


@pytest.mark.parametrize("with_wheels", [True, False])
def test_standing_still_adds_neither_drift_nor_key_scans(with_wheels: bool) -> None:
    poses = np.repeat(round_trip(1), 300, axis=0)
    wheels = np.zeros((300, 3)) if with_wheels else None
    estimates, odometry = drive(scans_along(ROOM, poses, fan(181), noise_m=0.02), wheels)
    assert [e.is_key for e in estimates] == [True] + [False] * 299
    late = np.array([e.pose for e in estimates[200:]])
    assert np.abs(late.mean(axis=0)).max() < 0.005
    assert len(odometry._submap._points) == 1


def test_a_corridor_is_measured_by_its_wheels() -> None:
    """Walls say nothing along it: the wheels' way stands, with a deviation that grows along and not across."""
    poses = np.stack((0.05 * np.arange(100), np.zeros(100), np.zeros(100)), axis=-1)
    estimates, _ = drive(scans_along(HALLWAY, poses, fan(360, 360.0)), poses * 1.03)
    assert off(estimates, poses * 1.03)[0] < 0.1
    for estimate in estimates[1:]:
        deviations = np.sqrt(estimate.since_key_covariance.diagonal())
        assert deviations[0] > 0.02 > 0.012 > deviations[1]


def test_what_comes_into_view_is_kept_where_the_robot_may_have_come_far() -> None:
    """A robot stands in a corridor, for all that walls tell: what is new makes key scans, what is known makes none."""
    poses, cabinet = np.zeros((60, 3)), np.array((((2.0, 0.4), (2.0, 0.9)), ((2.0, 0.4), (3.0, 0.4))))
    scans = scans_along(HALLWAY, poses, fan(181))
    assert sum(estimate.is_key for estimate in drive(scans)[0]) == 1
    seen = scans_along(np.concatenate((HALLWAY, cabinet)), poses, fan(181))
    assert sum(estimate.is_key for estimate in drive([*scans[:30], *seen[30:]])[0]) > 1


def test_keys_are_by_motion() -> None:
    poses = round_trip(81)
    estimates, odometry = drive(scans_along(ROOM, poses, fan(241, 240.0)))
    keys = [i for i, estimate in enumerate(estimates) if estimate.is_key]
    assert 20 < len(keys) < 60
    for first, second in zip(keys[:-1], keys[1:], strict=True):
        moved = between(poses[first], poses[second])
        assert math.hypot(moved[0], moved[1]) > 0.28 or abs(moved[2]) > math.radians(14.0)
        assert estimates[second].since_key == pytest.approx(moved, abs=0.03)
    assert len(odometry._submap._points) <= ScanOdometryConfig().submap_scans


def test_steps_add_up_to_poses() -> None:
    pose = np.zeros(3)
    for estimate in drive(scans_along(ROOM, round_trip(30), fan(181)))[0]:
        pose = compose(pose, estimate.step)
        assert pose == pytest.approx(estimate.pose)
        assert np.linalg.eigvalsh(estimate.step_covariance).min() > -1e-12


def test_frozen_wheels_that_jump_do_no_harm() -> None:
    """As those of MIT CSAIL: they stand for a second while the robot drives, and then jump to where it is."""
    poses = round_trip(120)
    wheels = np.array([between(poses[0], pose) for pose in poses])
    for start in (20, 50, 80):
        wheels[start : start + 10] = wheels[start]
    estimates, _ = drive(scans_along(ROOM, poses, fan(241, 240.0)), wheels)
    position, heading = off(estimates, poses)
    assert position < 0.05 and heading < 0.02


@pytest.mark.parametrize(
    ("rays", "degrees", "slips", "off_m", "off_rad"),
    [(180, 90.0, (20,), 0.1, 0.1), (180, 120.0, (20,), 0.1, 0.1), (60, 60.0, (20, 60), 0.2, 0.15)],
)
def test_wheels_that_slip_give_way_to_the_velocity(
    rays: int, degrees: float, slips: tuple[int, ...], off_m: float, off_rad: float
) -> None:
    """Wheels slip for 0.8 s at a time, while a noisy scanner sees little: the velocity knows the way."""
    poses = round_trip(120)
    steps = np.array([between(before, after) for before, after in zip(poses[:-1], poses[1:], strict=True)])
    for start, turn in zip(slips, (-0.1, 0.1), strict=False):
        steps[start : start + 8, 2] += turn
    wheels = np.zeros((120, 3))
    for k, step in enumerate(steps):
        wheels[k + 1] = compose(wheels[k], step)
    estimates, _ = drive(scans_along(ROOM, poses, fan(rays, degrees), noise_m=0.03), wheels)
    position, heading = off(estimates, poses)
    assert position < off_m and heading < off_rad
    assert not any(estimate.unsure for estimate in estimates)


def test_a_blind_lidar_is_no_worse_than_its_wheels() -> None:
    """Nothing comes back: the wheels stand, the estimate says so, and its deviations are theirs."""
    poses = round_trip(60)
    wheels = np.array([between(poses[0], pose) for pose in poses])
    nowhere = ROOM[:1] + 1000.0
    estimates, _ = drive(scans_along(nowhere, poses, fan(181)), wheels)
    assert off(estimates, poses)[0] < 1e-6
    assert all(estimate.unsure for estimate in estimates[1:])
    assert min(np.sqrt(estimate.step_covariance[0, 0]) for estimate in estimates[1:]) > 0.02


def test_late_wheels_are_found_out() -> None:
    """Scans are 0.12 s older than their stamps: the lag is found while driving."""
    count, lag_s = 300, 0.12
    fine = round_trip(count * 10, period=800)
    wheels, odometry = WheelOdometry(), ScanOdometry()
    for i in range(20, count):
        for j in range(10 * (i - 1), 10 * i, 2):
            wheels.add(round((j + 2) * 1e7), fine[j + 2])
        scan = scan_at(ROOM, fine[round(10 * i - 100 * lag_s)], i * STEP_NS, fan(181))
        odometry.update(SweptScan(scan), wheels)
    assert wheels.lag_s == pytest.approx(lag_s, abs=0.02)


@pytest.mark.parametrize("with_wheels", [False, True])
def test_a_match_of_few_points_after_a_pause_is_sure_by_wheels_alone(with_wheels: bool) -> None:
    """Half of the scan shows what was not there before: without wheels the robot may as well be where it was going."""
    poses = np.tile(round_trip(60)[0], (11, 1))
    scans = scans_along(ROOM, poses, fan(361, 360.0))
    late = replace(scans[-1], stamp_ns=scans[-2].stamp_ns + 5 * STEP_NS)
    seen = np.random.default_rng(0).random(len(late.points)) < 0.62
    scans[-1] = replace(late, points=np.where(seen[:, None], late.points, 0.4 * late.points))
    wheels = np.zeros((11, 3)) + 1e-3 * np.arange(11)[:, None]
    estimates, _ = drive(scans, wheels if with_wheels else None)
    last = estimates[-1]
    assert 0.5 <= last.share < 0.7 and last.searched == (not with_wheels) and not last.unsure
    assert np.hypot(*last.pose[:2]) < 0.05
    deviation = math.sqrt(last.since_key_covariance[0, 0])
    assert deviation < 0.05 if with_wheels else deviation > 0.15


def test_scans_come_in_order() -> None:
    odometry = ScanOdometry()
    scan = scan_at(ROOM, np.array((1.0, 1.0, 0.0)), 10)
    odometry.update(SweptScan(scan))
    with pytest.raises(ValueError, match="expected one after 10"):
        odometry.update(SweptScan(scan))


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="good_share"):
        ScanOdometryConfig(least_share=0.8)
    with pytest.raises(ValueError, match="positive"):
        ScanOdometryConfig(key_distance_m=0.0)
