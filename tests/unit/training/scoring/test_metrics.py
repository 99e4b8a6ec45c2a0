"""Trajectory errors against values computed on paper."""

import numpy as np
import pytest

from training.scoring.metrics import trajectory_error

STRAIGHT = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0]])


def moved(poses: np.ndarray, x: float, y: float, yaw: float) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    xy = poses[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
    return np.column_stack((xy, poses[:, 2] + yaw))


def test_errors_on_paper() -> None:
    estimate = STRAIGHT.copy()
    estimate[1:, 1] = [0.1, 0.2, 0.2]  # squares 0.01, 0.04, 0.04 over 4 frames: mean 0.0225
    estimate[1:, 2] = np.radians([1.0, -1.0, 2.0])  # squares 1, 1, 4: mean 1.5
    error = trajectory_error(estimate, STRAIGHT)
    assert error.position_rmse_m == pytest.approx(0.15)
    assert error.final_percent == pytest.approx(100.0 * 0.2 / 4.0)
    assert error.heading_rmse_deg == pytest.approx(np.sqrt(1.5))


def test_frames_of_reference_do_not_matter_but_nothing_else_is_aligned() -> None:
    rng = np.random.default_rng(0)
    estimate = STRAIGHT + rng.normal(0.0, 0.1, STRAIGHT.shape)
    plain = trajectory_error(estimate, STRAIGHT)
    other = trajectory_error(moved(estimate, 3.0, -2.0, 2.0), moved(STRAIGHT, -7.0, 1.0, -1.5))
    assert np.allclose(list(vars(other).values()), list(vars(plain).values()))
    # A heading that is wrong at the first frame turns all that follows: no alignment takes it away.
    turned = moved(STRAIGHT, 0.0, 0.0, 0.5)
    turned[0, 2] = 0.0
    assert trajectory_error(turned, STRAIGHT).final_percent == pytest.approx(100.0 * 2.0 * np.sin(0.25), rel=1e-6)


def test_heading_errors_are_wrapped() -> None:
    truth = STRAIGHT + [0.0, 0.0, np.pi - 0.01]
    truth[0, 2] = 0.0
    estimate = truth.copy()
    estimate[1:, 2] -= 2.0 * np.pi - 0.02
    error = trajectory_error(estimate, truth)
    assert error.heading_rmse_deg == pytest.approx(np.degrees(0.02) * np.sqrt(3 / 4))
