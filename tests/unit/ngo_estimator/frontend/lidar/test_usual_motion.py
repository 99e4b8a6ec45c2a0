"""How fast a robot's velocity changes is learned where walls tell it."""

import math

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.usual_motion import UsualMotion

PERIOD_S = 0.1


def watched(speeds: np.ndarray) -> UsualMotion:
    usual = UsualMotion(0.3)
    for speed in speeds:
        usual.observe(np.array((PERIOD_S * speed, 0.0, 0.0)), PERIOD_S)
    return usual


def test_the_change_of_a_wandering_velocity_is_found() -> None:
    wandering = np.cumsum(0.8 * math.sqrt(PERIOD_S) * np.random.default_rng(0).standard_normal(4000))
    assert watched(wandering).rate_m_s == pytest.approx(0.8, rel=0.25)


def test_a_slow_robot_keeps_the_least_deviations() -> None:
    usual = watched(np.concatenate((np.linspace(0.0, 0.6, 30), np.full(300, 0.6))))
    assert usual.largest_m_s == 0.3 and usual.rate_m_s < 0.3


def test_one_wrong_registration_is_no_acceleration() -> None:
    speeds = np.full(400, 0.5)
    speeds[200] = 20.0
    assert watched(speeds).rate_m_s < 0.3


def test_nothing_is_learned_across_steps_that_walls_do_not_tell() -> None:
    usual = UsualMotion(0.3)
    for speed in (0.2, 3.0) * 20:
        for _ in range(4):
            usual.observe(np.array((PERIOD_S * speed, 0.0, 0.0)), PERIOD_S)
        usual.interrupt()
    assert usual.rate_m_s < 0.3
