"""Where the next scan is expected, without wheels."""

import numpy as np
import pytest

from ngo_estimator.odometry.motion_prior import MotionPrior, MotionPriorConfig

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
