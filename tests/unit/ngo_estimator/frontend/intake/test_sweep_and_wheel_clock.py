"""What drivers say of times is measured: the sweep by the fit of scans, the wheels' clock and scale by turns."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ngo_estimator.frontend.intake import sweep
from ngo_estimator.frontend.intake.imu_turns import ImuTurns
from ngo_estimator.frontend.intake.wheel_clock import CorrectedWheels, WheelClock, WheelTruth
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import Array, between, compose
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.offline.lidar_run import LidarRun
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import LidarScan, WheelPose
from tests.unit.ngo_estimator.ray_casting import ROOM, cast

STEP_NS = 100_000_000
RAYS = 180
SENSOR = np.array((0.1, 0.0, 0.5))
BEGIN_NS = 10**12


def drive(count: int) -> Array:
    """Poses of a robot that turns to and fro at rates of its own, and drives ahead and back."""
    noise, poses, rate = np.random.default_rng(1), [np.array((1.2, 1.0, 0.6))], 0.0
    for k in range(count):
        if k % 6 == 0:
            rate = float(noise.uniform(-0.09, 0.09)) - 0.04 * (float(poses[-1][2]) - 0.6)
        poses.append(compose(poses[-1], np.array((0.04 if k // 40 % 2 == 0 else -0.04, 0.0, rate))))
    return np.array(poses)


def records(poses: Array, wheel_scale: float | Array = 1.0, ahead_s: float = 0.0, sweeps: bool = False) -> list[Any]:
    """Scans, which sweep from one stamp to the next or are taken at once, and wheels between them."""
    noise, made = np.random.default_rng(0), []
    angles = np.linspace(-math.pi, math.pi, RAYS, endpoint=False)
    wheels = np.zeros(3)
    for k, (pose, following) in enumerate(zip(poses[:-1], poses[1:], strict=True)):
        step = between(pose, following)
        for half in (0.0, 0.5):
            stamp_ns = BEGIN_NS + round((k + half) * STEP_NS + ahead_s * 1e9)
            made.append(WheelPose(stamp_ns, compose(wheels, half * step * wheel_scale)))
        wheels = compose(wheels, step * wheel_scale)
        if sweeps:
            sensors = [compose(compose(pose, step * ray / RAYS), SENSOR) for ray in range(RAYS)]
            seen = np.array([cast(ROOM, at, angle[None])[0] for at, angle in zip(sensors, angles, strict=True)])
        else:
            seen = cast(ROOM, compose(pose, SENSOR), angles)
        ranges = (seen + noise.normal(0.0, 0.005, RAYS)).astype(np.float32)
        time_increment = STEP_NS * 1e-9 / RAYS if sweeps else 0.0
        stamp_ns = BEGIN_NS + k * STEP_NS
        made.append(LidarScan(stamp_ns, -math.pi, math.tau / RAYS, ranges, 0.05, 30.0, time_increment, "laser"))
    apart_ns = round(ahead_s * 1e9) if abs(ahead_s) > 10.0 else 0  # then a recording keeps the order of arrival
    return sorted(made, key=lambda record: record.stamp_ns - apart_ns * isinstance(record, WheelPose))


def run_over(made: list[Any], poses: Array) -> tuple[float, LidarRun]:
    """The largest error of a path (m) that was learned about first, and its run."""
    run = LidarRun(MixtureLidar(), ScanTrajectory(iterations_per_step=1), Mounting(SENSOR))
    run.learn(made)
    whole = next(event for event in run.run(made) if isinstance(event, RecordedRun)).trajectory
    expected = np.array([between(poses[0], pose) for pose in poses[: len(whole.poses_xyyaw)]])
    return float(np.linalg.norm((whole.poses_xyyaw - expected)[:, :2], axis=1).max()), run


def turned_round(scan: LidarScan) -> LidarScan:
    last = scan.angle_min + scan.angle_increment * (RAYS - 1)
    return replace(scan, angle_min=last, angle_increment=-scan.angle_increment, ranges=scan.ranges[::-1])


SWEPT = records(drive(90), sweeps=True)


@pytest.mark.parametrize(
    ("factor", "turn_round", "said"),
    [
        (1.0, False, ""),
        (1.0, True, "in the other order than the driver says"),
        (-1.0, False, "in the other order than the driver says"),
        (1e9, False, "times from ray to ray are taken times 1e-09"),
        (RAYS, False, "times from ray to ray are taken times 0.00555556"),  # the time of the whole sweep
        (1e3, True, "in the other order than the driver says"),
        (77.0, False, "its sweep lasts 0.100 s in the order of its rays"),
    ],
)
def test_the_direction_and_the_time_of_a_sweep_are_measured(factor: float, turn_round: bool, said: str) -> None:
    made = []
    for record in SWEPT:
        if isinstance(record, LidarScan):
            changed = replace(record, time_increment=factor * record.time_increment)
            made.append(turned_round(changed) if turn_round else changed)
        else:
            made.append(record)
    off_m, run = run_over(made, drive(90))
    assert off_m < 0.03
    remarks = [line for line in run.remarks() if "older than their stamps" not in line]
    assert [said in line for line in remarks] == [True] if said else not remarks


STILL = drive(240)


def test_a_sweep_that_is_known_is_seldom_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    fits: list[float] = []
    fit = sweep._fit
    monkeypatch.setattr(sweep, "_fit", lambda first, second, time_s: fits.append(time_s) or fit(first, second, time_s))
    measured, stamp_ns, last, mounting = sweep.MeasuredSweep(), BEGIN_NS, STILL[0], Mounting(SENSOR)
    scans = [record for record in records(STILL) if isinstance(record, LidarScan)] * 8
    for number, scan in enumerate(scans):
        pose = STILL[number % (len(STILL) - 1)]
        assert measured.correct(replace(scan, stamp_ns=stamp_ns)).time_increment == 0.0
        measured.observe(stamp_ns, between(last, pose), None, STEP_NS * 1e-9, mounting)
        stamp_ns, last = stamp_ns + STEP_NS, pose
    assert 24 <= len(fits) < 0.1 * len(scans)


@pytest.mark.parametrize("ahead_s", [0.0, -1.3, 1.7e9])
def test_the_wheels_clock_is_found_at_any_distance(ahead_s: float) -> None:
    made = records(STILL, ahead_s=ahead_s)
    off_m, run = run_over(made, STILL)
    assert off_m < 0.03
    if ahead_s:
        side = "ahead of" if ahead_s > 0.0 else "behind"
        (line,) = [line for line in run.remarks() if side in line]
        assert float(line.split(" is ")[1].split(" s ")[0]) == pytest.approx(abs(ahead_s), abs=0.15)
    else:
        assert run.remarks() == []


@pytest.mark.parametrize(
    ("way", "turn", "said"),
    [
        (0.5, 0.5, ["turns are taken times 2", "ways are taken times 2"]),
        (1.0, -1.0, ["turns are taken times -"]),
        (-1.0, 1.0, ["ways are taken times -"]),
    ],
)
def test_wheels_of_another_scale_are_scaled(way: float, turn: float, said: list[str]) -> None:
    off_m, run = run_over(records(STILL, wheel_scale=np.array((way, way, turn))), STILL)
    assert off_m < 0.03
    assert all(each in line for each, line in zip(said, run.remarks(), strict=False))


def test_wheels_that_no_robot_drives_so_fast_are_left_out_until_their_scale_is_known() -> None:
    """By another clock such wheels say that the robot stands, and ways by scans that believe it tell no scale."""
    poses, clock, noise, useless = drive(600), WheelClock(), np.random.default_rng(3), []
    wheels = np.array([between(poses[0], pose) * (1000.0, 1000.0, 1.0) for pose in poses])
    for k, (pose, following) in enumerate(zip(poses[:-1], poses[1:], strict=True)):
        clock.add_wheels(BEGIN_NS + k * STEP_NS + 3_000_000_000, wheels[k])
        step = between(pose, following)
        step[0] *= noise.normal() if k < 100 else 1.0
        clock.add_step(BEGIN_NS + k * STEP_NS, BEGIN_NS + (k + 1) * STEP_NS, step)
        useless.append(clock.truth.useless)
    assert useless[149] and not useless[-1]
    assert clock.truth.way_scale == pytest.approx(0.001, rel=0.5)


def test_a_driver_that_begins_anew_at_the_origin_again_and_again_made_no_step() -> None:
    poses, wheels = drive(160), CorrectedWheels(ImuTurns())
    given = [record for record in records(poses) if isinstance(record, WheelPose)]
    begun = [between(given[k - k % 30].pose_xyyaw, each.pose_xyyaw) for k, each in enumerate(given)]
    made = [wheels.add(each.stamp_ns, pose, WheelTruth())[1] for each, pose in zip(given, begun, strict=True)]
    lost = np.array([between(made[k], made[k + 1]) for k in range(29, 300, 30)])
    assert np.abs(lost).max() < 1e-12
    kept = [between(made[k], made[k + 10]) - between(begun[k], begun[k + 10]) for k in range(60, 80)]
    assert np.abs(kept).max() < 1e-9


def test_an_encoder_that_dithers_at_the_origin_winds_nothing_up() -> None:
    wheels = CorrectedWheels(ImuTurns())
    for k in range(3001):
        given = np.array((0.0005, 0.0, 0.0033)) * (k % 2)
        made = wheels.add(BEGIN_NS + k * STEP_NS // 5, given, WheelTruth())[1]
    np.testing.assert_allclose(made, 0.0, atol=1e-9)


def test_wheels_of_a_robot_that_stands_stay_whatever_the_noise_of_scans() -> None:
    noise, clock = np.random.default_rng(0), WheelClock()
    for k in range(120 * 40):
        begin_ns, end_ns = BEGIN_NS + k * STEP_NS // 4, BEGIN_NS + (k + 1) * STEP_NS // 4
        clock.add_wheels(end_ns, np.array((0.3, 0.2, 0.1)))
        clock.add_step(begin_ns, end_ns, np.array((0.0, 0.0, noise.normal(0.0, 0.002))))
    assert not clock.truth.useless


def test_odometry_in_millimetres_is_corrected_and_handed_on_as_it_was() -> None:
    """`map` -> `odom` is made of what the robot says."""
    made = records(STILL, wheel_scale=np.array((1000.0, 1000.0, 1.0)))
    run = LidarRun(MixtureLidar(), ScanTrajectory(iterations_per_step=1), Mounting(SENSOR))
    run.learn(made)
    steps = [event.local for event in run.run(made) if isinstance(event, RecordedStep)]
    assert "ways are taken times 0.001" in run.remarks()[0]
    said = {record.stamp_ns: record.pose_xyyaw for record in made if isinstance(record, WheelPose)}
    handed_on = [step.robot_odom_xyyaw for step in steps[:-3]]
    np.testing.assert_allclose(handed_on, [said[step.stamp_ns] for step in steps[:-3]], atol=20.0)
    off = [between(STILL[0], STILL[k + 1]) - step.odom_xyyaw for k, step in enumerate(steps)]
    assert np.abs(np.array(off)[:, :2]).max() < 0.05


def test_wheels_are_not_to_blame_where_scans_alone_get_lost_as_well() -> None:
    """A robot goes straight on, so that turns tell nothing, and some scans see dust."""
    noise = np.random.default_rng(2)
    made = [
        replace(record, ranges=noise.uniform(0.2, 0.5, RAYS).astype(np.float32))
        if isinstance(record, LidarScan) and k % 30 > 26
        else record
        for k, record in enumerate(records(drive(1)[:1] + np.outer(np.arange(100), (0.01, 0.0, 0.0))))
    ]
    run = LidarRun(MixtureLidar(), ScanTrajectory(iterations_per_step=1), Mounting(SENSOR))
    assert not run.learn(made).useless


def test_wheels_without_a_heading_are_left_out() -> None:
    """Their ways are those of the room, not of the robot, and must measure no sweep."""
    poses = drive(160)
    made = records(poses, sweeps=True)
    flat = [replace(r, pose_xyyaw=r.pose_xyyaw * (1.0, 1.0, 0.0)) if isinstance(r, WheelPose) else r for r in made]
    off_m, run = run_over(flat, poses)
    assert off_m == run_over([record for record in made if isinstance(record, LidarScan)], poses)[0] < 0.06
    assert [line.partition(":")[2] for line in run.remarks()] == [" they are left out"]


@pytest.mark.parametrize("y", [1.0, -1.0])
def test_wheels_whose_y_has_the_other_sign_measure_no_sweep(y: float, monkeypatch: pytest.MonkeyPatch) -> None:
    begin, given = np.array((0.0, 0.0, 0.7)), []
    made = [
        replace(r, pose_xyyaw=compose(begin, r.pose_xyyaw) * (1.0, y, 1.0)) if isinstance(r, WheelPose) else r
        for r in SWEPT
    ]
    monkeypatch.setattr(sweep.MeasuredSweep, "observe", lambda _, *taken: given.append(taken[2] is not None))
    run_over(made, drive(90))
    assert np.mean(given) < 0.4 if y < 0.0 else np.mean(given) > 0.9


def test_wheels_that_have_nothing_to_do_with_the_scans_are_left_out() -> None:
    made, other = records(STILL), records(drive(240)[::-1].copy())
    wheels = [record for record in other if isinstance(record, WheelPose)]
    turned = np.random.default_rng(3).normal(0.0, 0.1, len(wheels)).cumsum()
    mixed = [WheelPose(record.stamp_ns, np.array((0.0, 0.0, turned[k]))) for k, record in enumerate(wheels)] + [
        record for record in made if isinstance(record, LidarScan)
    ]
    off_m, run = run_over(sorted(mixed, key=lambda record: record.stamp_ns), STILL)
    assert off_m < 0.03 and "they are left out" in run.remarks()[0]
