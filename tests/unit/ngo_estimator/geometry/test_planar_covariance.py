"""Covariances of poses: against sampling, and against what is known."""

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_covariance import bounded, propagate, to_spatial


def test_propagation_agrees_with_sampled_steps() -> None:
    rng = np.random.default_rng(0)
    step = np.array([0.5, 0.1, 0.3])
    step_covariance = np.diag([0.01, 0.005, 0.008]) ** 2
    noise = rng.multivariate_normal(np.zeros(3), step_covariance, (20_000, 12))
    samples, exact = torch.zeros(20_000, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    covariance = np.zeros((3, 3))
    for index in range(12):
        samples = se2.compose(samples, torch.from_numpy(step + noise[:, index]))
        exact = se2.compose(exact, torch.from_numpy(step))
        covariance = propagate(covariance, exact.numpy(), step, step_covariance)
    sampled = np.cov((samples - exact).numpy().T)
    np.testing.assert_allclose(covariance, sampled, atol=0.04 * np.abs(sampled).max())


def test_heading_error_moves_the_end_of_a_straight_step_sideways() -> None:
    before = np.diag([0.0, 0.0, 0.01**2])
    after = propagate(before, np.array([2.0, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), np.zeros((3, 3)))
    np.testing.assert_allclose(after, [[0.0, 0.0, 0.0], [0.0, 4e-4, 2e-4], [0.0, 2e-4, 1e-4]], atol=1e-18)


def test_spatial_form_has_x_y_and_yaw_in_their_places() -> None:
    spatial = to_spatial(np.arange(1.0, 10.0).reshape(3, 3)).reshape(6, 6)
    assert spatial[0].tolist() == [1.0, 2.0, 0.0, 0.0, 0.0, 3.0]
    assert spatial[1].tolist() == [4.0, 5.0, 0.0, 0.0, 0.0, 6.0]
    assert spatial[5].tolist() == [7.0, 8.0, 0.0, 0.0, 0.0, 9.0]
    assert not spatial[2:5].any()


@pytest.mark.parametrize("exponents", [(-4, -4, -6), (-12, 0, 0), (-10, -10, -10), (0, 0, 5), (-9, 3, -9)])
def test_a_bounded_covariance_keeps_its_axes(exponents: tuple[int, int, int]) -> None:
    """Variances from 1e-10 to 1e4 stay, others become the nearer of these."""
    generator = np.random.default_rng(5)
    for _ in range(20):
        axes = np.linalg.qr(generator.standard_normal((3, 3)))[0]
        variances = 10.0 ** np.array(exponents) * generator.uniform(1.0, 3.0, 3)
        expected = (axes * np.clip(variances, 1e-10, 1e4)) @ axes.T
        assert bounded((axes * variances) @ axes.T) == pytest.approx(
            expected, rel=1e-6, abs=1e-3 * 1e-10 + 1e-14 * variances.max()
        )
