"""Wheels: motion between two scans, its deviations, and the lag against the scans."""

import math

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.wheel_lag import WheelLag, WheelLagConfig
from ngo_estimator.frontend.lidar.wheel_odometry import WheelOdometry, WheelOdometryConfig
from ngo_estimator.geometry.planar_motion import Array

SECOND = 10**9


def heading(time_s: float) -> float:
    """A robot that wanders: turns of several speeds."""
    return 0.8 * math.sin(0.9 * time_s) + 0.3 * math.sin(2.3 * time_s + 1.0)


def poses_at(times_s: Array) -> Array:
    return np.array([(0.5 * t, 0.0, heading(t)) for t in times_s])


def test_poses_are_interpolated_across_pi() -> None:
    wheels = WheelOdometry()
    wheels.add(5 * SECOND, np.array((1.0, 0.0, 3.1)))
    wheels.add(6 * SECOND, np.array((2.0, 1.0, -3.1)))
    middle = wheels.pose_at(5 * SECOND + SECOND // 2)
    assert middle is not None and middle[:2] == pytest.approx((1.5, 0.5))
    assert abs(middle[2]) == pytest.approx(math.pi)


def test_silent_wheels_have_no_pose() -> None:
    wheels = WheelOdometry()
    assert wheels.pose_at(0) is None
    for i in range(3):
        wheels.add(i * SECOND, np.array((float(i), 0.0, 0.0)))
    assert wheels.pose_at(-SECOND) is None and wheels.pose_at(4 * SECOND) is None
    late = wheels.pose_at(2 * SECOND + SECOND // 4)
    assert late is not None and late == pytest.approx((2.25, 0.0, 0.0))


def test_late_messages_are_dropped_and_memory_is_bounded() -> None:
    wheels = WheelOdometry(WheelOdometryConfig(kept=8))
    for i in range(1000):
        wheels.add(i * SECOND, np.array((float(i), 0.0, 0.0)))
        wheels.add(i * SECOND - 1, np.array((-9.0, 0.0, 0.0)))
    assert wheels.pose_at(995 * SECOND) == pytest.approx((995.0, 0.0, 0.0))
    assert wheels.pose_at(500 * SECOND) is None
    assert wheels._rows.shape == (16, 4)


def test_deviations_grow_with_way_and_turn() -> None:
    config = WheelOdometryConfig()
    assert config.deviations(np.zeros(3)) == pytest.approx((0.03, 0.03, math.radians(1.0)))
    assert config.deviations(np.array((3.0, 4.0, -1.0))) == pytest.approx((0.58, 0.58, math.radians(21.0) + 0.2))


@pytest.mark.parametrize("lag_s", [-0.23, -0.1, 0.1, 0.13, 0.3])
@pytest.mark.parametrize("wheel_step_s", [0.02, 0.17])
def test_the_lag_is_found(lag_s: float, wheel_step_s: float) -> None:
    """Scans are older than their stamps by the lag: what they measure is over by then. Wheels turn by 5 % too much."""
    generator = np.random.default_rng(1)
    wheels = WheelOdometry()
    stamps = np.arange(0.0, 60.0, 0.11)
    turns = np.diff([heading(t - lag_s) for t in stamps]) + 0.003 * generator.standard_normal(len(stamps) - 1)
    next_wheel = 0.0
    for start, end, turn in zip(stamps[:-1], stamps[1:], turns, strict=True):
        while next_wheel <= end:
            wheels.add(round(next_wheel * 1e9), np.array((0.0, 0.0, 1.05 * heading(next_wheel))))
            next_wheel += wheel_step_s
        wheels.observe_turn(round(start * 1e9), round(end * 1e9), float(turn))
    assert wheels.lag_s == pytest.approx(lag_s, abs=0.02)
    assert len(wheels.lag._waiting) < 64


def test_no_lag_is_claimed_without_turns_or_without_a_lag() -> None:
    straight, right = WheelOdometry(), WheelOdometry()
    generator = np.random.default_rng(2)
    for i in range(600):
        time = 0.1 * i
        straight.add(round(time * 1e9), np.array((time, 0.0, 0.0)))
        right.add(round(time * 1e9), np.array((time, 0.0, heading(time))))
        if i:
            span = (round((time - 0.1) * 1e9), round(time * 1e9))
            straight.observe_turn(*span, 0.004 * generator.standard_normal())
            right.observe_turn(*span, heading(time) - heading(time - 0.1) + 0.004 * generator.standard_normal())
    assert straight.lag_s == 0.0
    assert abs(right.lag_s) < 0.01


def test_noisy_wheels_that_are_as_slow_as_the_scans_show_no_lag() -> None:
    """Interpolation averages the noise of two poses: that is no reason for half a period of lag."""
    generator = np.random.default_rng(3)
    for _ in range(4):
        wheels, noise = WheelOdometry(), 0.0
        for i in range(1500):
            time = 0.17 * i
            noise += 0.03 * generator.standard_normal()
            wheels.add(round(time * 1e9), np.array((0.0, 0.0, heading(time) + noise)))
            if i:
                turn = heading(time) - heading(time - 0.17) + 0.003 * generator.standard_normal()
                wheels.observe_turn(round((time - 0.17) * 1e9), round(time * 1e9), turn)
        assert abs(wheels.lag_s) < 0.02


def test_a_pose_reads_the_wheels_at_the_lag() -> None:
    wheels = WheelOdometry()
    for i in range(50):
        wheels.add(i * SECOND // 10, np.array((0.1 * i, 0.0, 0.0)))
    wheels.lag.lag_s = 0.25
    assert wheels.pose_at(4 * SECOND) == pytest.approx((3.75, 0.0, 0.0))


def test_bad_wheels_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        WheelOdometry().add(0, np.array((0.0, math.nan, 0.0)))
    with pytest.raises(ValueError, match="finite"):
        WheelLag().observe(0.0, 1.0, math.inf)
    with pytest.raises(ValueError, match="still_m"):
        WheelOdometryConfig(still_m=0.0)
    with pytest.raises(ValueError, match="step_s"):
        WheelLagConfig(step_s=1.0)
