"""Wheels that repeat a pose: a robot that stands, or one that drives on unseen."""

import math

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.wheel_freezes import WheelFreezesConfig
from ngo_estimator.frontend.lidar.wheel_odometry import WheelOdometry
from ngo_estimator.geometry.planar_motion import compose

PERIOD_S = 0.05
SPEED = 0.7


def wheels_that(ways: list[float], turns: list[float] | None = None) -> WheelOdometry:
    """Wheels that count these ways (m) and turns (rad), one each period."""
    wheels, counted, heading = WheelOdometry(), 0.0, 0.0
    for k, way in enumerate([0.0, *ways]):
        counted, heading = counted + way, heading + (turns[k - 1] if turns and k else 0.0)
        wheels.add(round(k * PERIOD_S * 1e9), np.array((counted, 0.0, math.remainder(heading, math.tau))))
    return wheels


def frozen_s(wheels: WheelOdometry, at_s: float) -> float:
    return wheels.frozen_s(round(at_s * 1e9))


def test_wheels_that_stop_at_once_froze() -> None:
    wheels = wheels_that([SPEED * PERIOD_S] * 20 + [0.0] * 10)
    assert frozen_s(wheels, 0.95) == 0.0
    assert frozen_s(wheels, 1.3) == pytest.approx(0.3)
    velocity, deviations = wheels.velocity_before_freeze(round(1.3e9)) or (None, None)
    assert velocity == pytest.approx((SPEED, 0.0, 0.0)) and (deviations > 0.0).all()


def test_a_robot_that_brakes_stands() -> None:
    speeds = [SPEED] * 20 + [SPEED - 1.5 * PERIOD_S * k for k in range(1, 10) if 1.5 * PERIOD_S * k < SPEED]
    wheels = wheels_that([speed * PERIOD_S for speed in speeds] + [0.0] * 10)
    assert frozen_s(wheels, len(speeds) * PERIOD_S + 0.3) == 0.0


def test_a_slow_robot_stands() -> None:
    wheels = wheels_that([0.2 * PERIOD_S] * 20 + [0.0] * 10)
    assert frozen_s(wheels, 1.3) == 0.0


def test_a_turn_that_ends_at_once_froze() -> None:
    """More than once round: the pose repeats in its last digits alone."""
    wheels = wheels_that([0.0] * 150, [1.3 * PERIOD_S] * 140 + [0.0] * 10)
    assert frozen_s(wheels, 7.3) == pytest.approx(0.3)


def test_wheels_that_count_again_froze_until_then() -> None:
    wheels = wheels_that([SPEED * PERIOD_S] * 20 + [0.0] * 19 + [SPEED * PERIOD_S * 20] + [SPEED * PERIOD_S] * 5)
    assert frozen_s(wheels, 1.97) == pytest.approx(0.97)  # between the last pose that stood and the first that did not
    assert frozen_s(wheels, 2.0) == 0.0 and frozen_s(wheels, 1.0) == 0.0
    assert wheels.velocity_before_freeze(round(2.1e9)) is None


def test_what_stands_for_long_stands() -> None:
    ways = [SPEED * PERIOD_S] * 20 + [0.0] * 60
    assert frozen_s(wheels_that(ways), 3.0) == 0.0
    assert frozen_s(wheels_that([*ways, SPEED * PERIOD_S]), 3.0) == 0.0


def test_the_lag_counts() -> None:
    wheels = wheels_that([SPEED * PERIOD_S] * 20 + [0.0] * 10)
    wheels.lag.lag_s = 0.2
    assert frozen_s(wheels, 1.3) == pytest.approx(0.1)


def test_settings_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="braking_s is 0"):
        WheelFreezesConfig(braking_s=0.0)


def test_drivers_that_repeat_each_pose_froze_never() -> None:
    """An encoder of 10 Hz, published at 20 Hz."""
    wheels = wheels_that([SPEED * 2 * PERIOD_S, 0.0] * 20)
    assert not any(frozen_s(wheels, 0.01 * k) for k in range(200))


def test_a_jump_of_wheels_that_stand_is_no_freeze() -> None:
    wheels = wheels_that([0.0] * 20 + [5.0] + [0.0] * 20)
    assert not any(frozen_s(wheels, 0.01 * k) for k in range(210))


def test_wheels_that_catch_up_and_stand_froze_once() -> None:
    wheels = wheels_that([SPEED * PERIOD_S] * 20 + [0.0] * 19 + [0.5] + [0.0] * 20)
    assert frozen_s(wheels, 1.9) > 0.0 and frozen_s(wheels, 2.5) == 0.0


def test_the_velocity_before_a_freeze_is_that_at_the_end_of_an_arc() -> None:
    wheels, pose = WheelOdometry(), np.zeros(3)
    for k in range(30):
        wheels.add(round(k * PERIOD_S * 1e9), pose)
        if k < 20:
            pose = compose(pose, np.array((SPEED * PERIOD_S, 0.0, 1.2 * PERIOD_S)))
    velocity, _ = wheels.velocity_before_freeze(round(1.3e9)) or (None, None)
    assert velocity == pytest.approx((SPEED, 0.0, 1.2), abs=0.03)
