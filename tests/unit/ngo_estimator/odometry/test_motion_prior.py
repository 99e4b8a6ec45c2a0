"""Where the next scan is expected, with wheels and without."""

import math

import numpy as np
import pytest

from ngo_estimator.odometry.motion_prior import MotionPrior, MotionPriorConfig, Prediction
from ngo_estimator.odometry.wheel_odometry import WheelOdometry

PERIOD_NS = 100_000_000
STEP = np.array((0.05, 0.0, 0.02))
SURE = np.diag((1e-6, 1e-6, 1e-8))


def driven(steps: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The motion that is expected next, after steps with covariances."""
    prior = MotionPrior(MotionPriorConfig())
    prior.begin(0, np.zeros(3), None)
    for k, (step, covariance) in enumerate(steps, 1):
        prior.predict(k * PERIOD_NS, np.zeros(3), np.zeros((3, 3)), None)
        prior.accept(k * PERIOD_NS, np.zeros(3), step, covariance, False, False)
    return prior.predict((len(steps) + 1) * PERIOD_NS, np.zeros(3), np.zeros((3, 3)), None).mean


def test_a_measured_velocity_goes_on() -> None:
    assert driven([(STEP, SURE)] * 3) == pytest.approx(STEP, abs=1e-4)


def test_an_open_direction_tells_no_velocity() -> None:
    """Along a corridor the step is a guess: the speed stays, and the measured turn counts."""
    along = np.diag((1.0, 1e-6, 1e-8))
    expected = driven([(STEP, SURE)] * 3 + [(np.array((0.4, 0.0, 0.03)), along)] * 3)
    assert expected[0] == pytest.approx(STEP[0], abs=0.03)
    assert expected[2] == pytest.approx(0.03, abs=1e-3)


def test_fast_scans_that_are_noisy_are_averaged() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.01, (40, 3)) * (1.0, 1.0, 0.1)
    covariance = np.diag((1e-4, 1e-4, 1e-6))
    last = [driven([(STEP + each, covariance) for each in noise[:count]]) - STEP for count in range(20, 40)]
    assert np.std(last, axis=0)[0] < 0.9 * 0.01


def followed(counted: list[np.ndarray], measured: list[np.ndarray]) -> list[Prediction]:
    """The prior of each scan, from wheels at the same stamps and the poses that the scans had in the end."""
    wheels, prior, predictions = WheelOdometry(), MotionPrior(MotionPriorConfig()), []
    wheels.add(0, counted[0])
    prior.begin(0, measured[0], wheels)
    for k in range(1, len(counted)):
        wheels.add(k * PERIOD_NS, counted[k])
        predictions.append(prior.predict(k * PERIOD_NS, measured[k - 1], np.eye(3) * 1e-4, wheels))
        prior.accept(k * PERIOD_NS, measured[k], measured[k] - measured[k - 1], SURE, k % 8 == 0, False)
    return predictions


def test_wheels_that_freeze_and_catch_up_are_doubted_meanwhile() -> None:
    """On the spot at 1.5 rad/s, so that the turns alone tell it."""
    measured = [np.array((0.0, 0.0, 0.15 * k)) for k in range(20)]
    counted = [measured[8] if 8 <= k < 13 else pose for k, pose in enumerate(measured)]
    trusted = [prediction.measured for prediction in followed(counted, measured)]
    assert trusted == [k < 9 or k > 13 for k in range(1, 20)]
    caught_up = followed(counted, measured)[12]
    assert any(start[2] == pytest.approx(measured[13][2], abs=0.02) for start in caught_up.starts)
    again = followed(counted, measured)[14]
    assert again.mean == pytest.approx(measured[15], abs=0.01)


def test_wheels_that_stand_for_long_are_believed() -> None:
    """Noisy scans of a robot that stands look like motion: that is no reason to doubt the wheels for ever."""
    noise = np.random.default_rng(0).normal(0.0, 0.02, (80, 3)) * (1.0, 1.0, 0.2)
    predictions = followed([np.zeros(3)] * 80, list(noise))
    assert not all(prediction.measured for prediction in predictions[:19])
    assert all(prediction.measured for prediction in predictions[21:])
    assert all(math.sqrt(prediction.covariance[0, 0]) < 0.04 for prediction in predictions[21:])
