"""Errors of stretches of steps against known answers, and that likelihood finds the factors that made the errors."""

import math

import numpy as np
import torch

from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.geometry.planar_motion import compose
from ngo_estimator.networks.step_scaling import STEP_EVIDENCE
from training.data.lidar_steps import KeySteps
from training.data.step_windows import figures, negative_log_likelihood, squared_deviations, windows_of
from training.train_step_deviation import Arguments, data_of, fitted

STEP = np.array((0.3, 0.0, 0.1))
DEVIATIONS = np.array((0.01, 0.01, 0.004))


def drive(steps: int, factor: float = 1.0, seed: int = 0) -> KeySteps:
    """A drive along a circle; deviations are ``factor`` times what its covariances say."""
    random = np.random.default_rng(seed)
    truth, relative = [np.zeros(3)], []
    for _ in range(steps):
        truth.append(compose(truth[-1], STEP))
        relative.append(STEP + factor * DEVIATIONS * random.normal(size=3))
    evidence = np.zeros((steps, len(STEP_EVIDENCE)))
    return KeySteps(np.stack(truth), np.stack(relative), np.tile(np.diag(DEVIATIONS**2), (steps, 1, 1)), evidence)


def test_the_covariance_of_a_stretch_is_that_of_its_steps_one_after_the_other() -> None:
    windows = windows_of(drive(4, factor=0.0), 4, (0.005, 0.002))
    covariance, pose = np.zeros((3, 3)), np.zeros(3)
    floor = np.diag((0.005**2, 0.005**2, 0.002**2))
    for _ in range(4):
        pose = compose(pose, STEP)
        covariance = propagate(covariance, pose, STEP, np.diag(DEVIATIONS**2) + floor)
    found = (windows.jacobian @ windows.covariance @ windows.jacobian.mT).sum(1) + windows.rest
    np.testing.assert_allclose(found[0].numpy(), covariance, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(windows.error.numpy(), 0.0, atol=1e-6)


def test_the_error_of_one_step_in_deviations() -> None:
    moved = drive(1, factor=0.0)
    moved.relative[0] += 2.0 * DEVIATIONS
    squared, log_root = squared_deviations(windows_of(moved, 1, (0.0, 0.0)), torch.zeros(1, 1, 2))
    np.testing.assert_allclose(squared.numpy(), 12.0, rtol=1e-3)
    np.testing.assert_allclose(log_root.numpy(), math.log(DEVIATIONS.prod()), rtol=1e-5)


def test_likelihood_is_highest_for_the_right_factor() -> None:
    windows = windows_of(drive(2000, factor=3.0), 1, (0.0, 0.0))
    losses = [
        float(negative_log_likelihood(windows, torch.full((2000, 1, 2), math.log(f))).mean()) for f in (1.0, 2.6, 7.0)
    ]
    assert losses[1] < losses[0] and losses[1] < losses[2]
    assert figures(windows, torch.full((2000, 1, 2), math.log(3.0)))["within_3"] > 0.95
    assert figures(windows, torch.zeros(2000, 1, 2))["within_3"] < 0.5


def test_training_finds_deviations_that_are_too_small() -> None:
    data = data_of([drive(300, factor=10.0), drive(300, factor=10.0, seed=1)], windows=(1, 4))
    network, loss = fitted(data, Arguments(steps=60))
    with torch.no_grad():
        before = sum(negative_log_likelihood(w, 0.0 * network(w.evidence)).mean() for w in data.values())
        factors = network(data[1].evidence).exp().mean(dim=(0, 1))
    assert loss < float(before) - 0.5
    assert (factors > 3.0).all()


def test_a_drive_that_is_too_short_has_no_stretches() -> None:
    assert len(windows_of(drive(3), 4, (0.0, 0.0))) == 0
