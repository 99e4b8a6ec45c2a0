"""Rows of the table of Doom maps."""

import numpy as np
import torch

from ngo_estimator.geometry import se2
from training.scoring.doom_rows import ActionsFit, Estimate, errors_of, odometry


def drive(rng: np.random.Generator, steps: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Actions and true poses of a robot that does at once what it is told."""
    actions = rng.integers(3, size=steps).astype(np.uint8)
    relative = np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, -0.1]])[actions]
    poses = se2.r2g(torch.from_numpy(relative)).numpy()
    return actions, np.concatenate((np.zeros((1, 3)), poses))


def test_a_robot_that_follows_its_actions_is_known_from_them() -> None:
    rng = np.random.default_rng(0)
    actions, poses = drive(rng)
    fit = ActionsFit.of([drive(rng) for _ in range(3)])
    errors = errors_of(fit.estimate({"actions": actions}), poses[1:])
    assert errors["ate_m"] < 1e-4 and errors["translation_percent"] < 1e-2


def test_the_truth_has_no_error_and_a_wrong_heading_is_outside() -> None:
    _, poses = drive(np.random.default_rng(1), 50)
    found = odometry(se2.g2r(torch.from_numpy(poses[1:])).numpy(), np.broadcast_to(1e-4 * np.eye(3), (50, 3, 3)))
    errors = errors_of(found, poses[1:])
    assert errors["ate_m"] < 1e-9 and errors["within_3_std"] == 1.0
    turned = Estimate(found.poses, found.published + [0.0, 0.0, 1.0], found.covariances)
    assert errors_of(turned, poses[1:])["within_3_std"] == 0.0
