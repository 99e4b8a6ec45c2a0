"""The mixture of hypotheses learns from matches: numbers that were worked out by hand."""

import math

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.frontend.lidar.motion_mixture import ANY, LAST, LOOSE, NONE, TIGHT, VELOCITY, MotionMixture

EXACT = np.diag((1e-6, 1e-6, 1e-6))
ORIGIN = np.zeros(3)
AHEAD = np.array((0.2, 0.0, 0.1))


def taught(found: np.ndarray, wheels: np.ndarray, times: int) -> MotionMixture:
    mixture = MotionMixture(MixtureConfig())
    for _ in range(times):
        mixture.foretell(0.0, wheels, wheels, 1.0)
        mixture.learn(found, EXACT)
        mixture.take(TIGHT, ORIGIN, found, EXACT, EXACT)
    return mixture


def test_wheels_that_are_right_become_heavy_and_sharp() -> None:
    mixture = taught(AHEAD, AHEAD, 200)
    assert mixture.weights[TIGHT] > 0.4
    mixture.foretell(0.0, AHEAD, AHEAD, 1.0)
    assert mixture.heaviest in (TIGHT, VELOCITY)
    assert math.sqrt(mixture.step_covariance(TIGHT)[0, 0] / 8.0) < 0.005


def test_wheels_that_turn_the_wrong_way_lose_their_weight() -> None:
    mixture = taught(AHEAD, AHEAD * (1.0, 1.0, -1.0), 200)
    assert (
        mixture.weights[LAST] + mixture.weights[VELOCITY] > 0.8
        and mixture.weights[TIGHT] + mixture.weights[LOOSE] < 0.1
    )


def test_a_robot_that_stands_teaches_nothing() -> None:
    mixture = taught(np.zeros(3), np.zeros(3), 100)
    np.testing.assert_array_equal(mixture.weights, MotionMixture(MixtureConfig()).weights)


def test_one_match_moves_the_weights_by_its_shares() -> None:
    """All hypotheses but the wheels are far off: the tight wheels take the rate's part from all others."""
    config = MixtureConfig(first_factors=(1.0, 50.0, 1.0, 1.0, 1.0, 1.0), least_factors=(1.0,) * 6, most_factor=50.0)
    mixture = MotionMixture(config)
    mixture.foretell(0.0, AHEAD, AHEAD, 1.0)
    before = mixture.weights.copy()
    mixture.learn(AHEAD, EXACT)
    rate = config.learn_rate  # way and turn teach at the whole rate
    expected = before[TIGHT] + rate * (1.0 - before[TIGHT])
    assert abs(mixture.weights[TIGHT] - expected) < 2e-3


def test_what_a_match_leaves_open_teaches_no_deviation() -> None:
    """Along a corridor the match has the deviation of the prior: the factor stays."""
    mixture = MotionMixture(MixtureConfig())
    mixture.foretell(0.0, AHEAD, AHEAD, 1.0)
    before = mixture.step_covariance(TIGHT)
    mixture.learn(AHEAD, np.diag((1e6, 1e6, 1e6)))
    mixture.foretell(0.0, AHEAD, AHEAD, 1.0)
    np.testing.assert_allclose(mixture.step_covariance(TIGHT), before, rtol=1e-3)


def test_calibration_finds_scale_and_yaw_of_the_scanner() -> None:
    yaw = math.radians(3.0)
    mixture = MotionMixture(MixtureConfig(certain_m=1.0))
    noise = np.random.default_rng(0)
    for _ in range(500):
        counted = np.array((noise.uniform(0.05, 0.25), 0.0, noise.uniform(-0.1, 0.1)))
        found = np.array((1.1 * counted[0] * math.cos(yaw), 1.1 * counted[0] * math.sin(yaw), counted[2]))
        mixture.foretell(0.0, counted @ mixture.calibration, counted, 1.0)
        mixture.learn(found, EXACT)
    forward = mixture.calibration[0]
    assert abs(math.hypot(forward[0], forward[1]) - 1.1) < 0.02
    assert abs(math.atan2(forward[1], forward[0]) - yaw) < 0.01


def test_the_last_velocity_goes_on_by_time_and_the_last_displacement_does_not() -> None:
    mixture = MotionMixture(MixtureConfig())
    mixture.foretell(0.0, None, None, 2.0)
    mixture.take(ANY, ORIGIN, np.array((0.2, 0.0, 0.0)), EXACT, EXACT)
    mixture.foretell(0.0, None, None, 0.5)
    np.testing.assert_allclose(mixture.steps[LAST], (0.2, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(mixture.steps[VELOCITY], (0.05, 0.0, 0.0), atol=1e-12)


def test_dead_reckoning_has_the_covariance_of_all_hypotheses() -> None:
    """Wheels turn half a turn more than the velocity: what has a weight beside the wheels widens the heading."""
    mixture = MotionMixture(MixtureConfig())
    mixture.foretell(0.0, np.array((0.0, 0.0, 1.5)), np.zeros(3), 1.0)
    pose, covariance = mixture.foretold(ORIGIN, np.zeros((3, 3)))
    others = mixture.weights[[LAST, VELOCITY, NONE]].sum()
    assert pose[2] == 1.5
    assert covariance[2, 2] > others * 1.5**2


def test_a_hypothesis_of_no_weight_is_not_formed_and_anything_stays() -> None:
    mixture = MotionMixture(MixtureConfig(first_weights=(0.0, 0.6, 0.0, 0.2, 0.1, 0.1)))
    mixture.foretell(0.0, np.array((0.1, 0.0, 0.0)), np.array((0.1, 0.0, 0.0)), 1.0)
    assert mixture.usable == [1, 3, 4, 5]
    mixture.learn(np.array((0.1, 0.0, 0.0)), 1e-6 * np.eye(3))
    assert mixture.weights[[0, 2]].tolist() == [0.0, 0.0] and abs(mixture.weights.sum() - 1.0) < 1e-12
    mixture.foretell(0.0, None, None, 1.0)
    assert mixture.usable == [3, 4, 5]
    with pytest.raises(ValueError, match="first_weights"):
        MixtureConfig(first_weights=(0.5, 0.1, 0.1, 0.1, 0.2, 0.0))
