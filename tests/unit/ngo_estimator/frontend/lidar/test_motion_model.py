"""Which velocity follows which is learned where walls tell both."""

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.motion_model import MotionModel
from ngo_estimator.geometry.planar_motion import Array

PERIOD_S = 0.1


def turning_and_driving(steps: int, noise: float = 0.01) -> Array:
    """Velocities ``(steps, 3)`` of a robot that turns on the spot to either side, and then drives on."""
    random, velocity, way = np.random.default_rng(1), np.zeros(3), []
    for k in range(steps):
        turns = (k // 15) % 3 == 0
        aim = np.array((0.05, 0.0, 1.0 if (k // 45) % 2 else -1.0) if turns else (0.6, 0.0, 0.0))
        velocity = velocity + 0.3 * (aim - velocity)
        way.append(velocity + noise * random.standard_normal(3))
    return np.array(way)


def learned(velocities: Array) -> MotionModel:
    model = MotionModel()
    for velocity in velocities:
        model.observe(velocity, PERIOD_S)
    return model


def test_a_robot_that_stops_turning_drives_on() -> None:
    model = learned(turning_and_driving(400))
    ahead, turning = (model.after(np.array((0.3, 0.0, turn)), PERIOD_S) for turn in (0.0, 1.0))
    assert ahead is not None and turning is not None
    assert ahead.mean[0] > 0.33 and turning.mean[0] < 0.28


def test_both_sides_are_one() -> None:
    model = learned(turning_and_driving(400))
    left, right = (model.after(np.array((0.3, side * 0.1, side * 0.8)), PERIOD_S) for side in (1.0, -1.0))
    assert left is not None and right is not None
    assert left.mean == pytest.approx(right.mean * (1.0, -1.0, -1.0))


def test_the_derivative_and_the_deviations_are_right() -> None:
    way = turning_and_driving(3000)
    model = learned(way[:400])
    velocity = np.array((0.2, 0.01, -0.5))
    found = model.after(velocity, PERIOD_S)
    assert found is not None
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        more, less = model.after(velocity + step, PERIOD_S), model.after(velocity - step, PERIOD_S)
        assert more is not None and less is not None
        assert (more.mean - less.mean) / 2e-6 == pytest.approx(found.by_velocity[:, axis], abs=1e-6)
    off = []
    for before, after in zip(way[400:-1], way[401:], strict=True):
        expected = model.after(before, PERIOD_S)
        assert expected is not None
        error = after - expected.mean
        off.append(error @ np.linalg.solve(expected.covariance, error))
    assert 0.5 < np.mean(off) < 3.0


def test_nothing_is_said_before_it_is_known_to_tell_more_than_a_constant_velocity() -> None:
    assert learned(turning_and_driving(40)).after(np.zeros(3), PERIOD_S) is None
    wandering = np.cumsum(0.05 * np.random.default_rng(0).standard_normal((1000, 3)), axis=0)
    assert learned(wandering).after(np.zeros(3), PERIOD_S) is None


def test_one_wrong_registration_teaches_little() -> None:
    way = turning_and_driving(401)
    clean = learned(way).after(np.zeros(3), PERIOD_S)
    way[380] = (8.0, 3.0, 2.0)
    wrong = learned(way).after(np.zeros(3), PERIOD_S)
    assert clean is not None and wrong is not None
    assert np.sqrt(wrong.covariance.diagonal()) == pytest.approx(np.sqrt(clean.covariance.diagonal()), rel=0.1)
    assert wrong.mean == pytest.approx(clean.mean, abs=0.1)


def test_a_robot_that_never_moves_teaches_nothing() -> None:
    model = learned(np.zeros((20_000, 3)))
    assert model.after(np.zeros(3), PERIOD_S) is None


def test_nothing_is_learned_across_steps_that_walls_do_not_tell() -> None:
    model = MotionModel()
    for velocity in turning_and_driving(400):
        model.observe(velocity, PERIOD_S)
        model.interrupt()
    assert model.after(np.zeros(3), PERIOD_S) is None


def test_a_robot_that_only_speeded_up_does_not_speed_up_for_ever() -> None:
    """What is predicted stays within what was seen, or nothing is."""
    random = np.random.default_rng(0)
    speeding = np.stack((0.2 + 0.014 * np.arange(80), np.zeros(80), np.zeros(80)), axis=1)
    model = learned(speeding + 0.002 * random.standard_normal((80, 3)))
    velocity = speeding[-1]
    for _ in range(100):
        following = model.after(velocity, PERIOD_S)
        velocity = velocity if following is None else following.mean
    assert velocity[0] < speeding[-1, 0] + 0.05


def test_nothing_is_said_of_times_longer_than_those_it_learned_from() -> None:
    model = learned(turning_and_driving(400))
    assert model.after(np.zeros(3), 2.0 * PERIOD_S) is not None
    assert model.after(np.zeros(3), 5.0 * PERIOD_S) is None
