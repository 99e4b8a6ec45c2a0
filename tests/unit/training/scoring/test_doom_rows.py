"""Rows of the table of Doom maps."""

import numpy as np
import torch

from ngo_estimator.geometry import se2
from training.scoring.doom_rows import Estimate, errors_of, odometry


def test_the_truth_has_no_error_and_a_wrong_heading_is_outside() -> None:
    relative = np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.1]])[np.arange(50) % 2]
    truth = se2.r2g(torch.from_numpy(relative)).numpy()
    found = odometry(relative, np.broadcast_to(1e-4 * np.eye(3), (50, 3, 3)))
    errors = errors_of(found, truth)
    assert errors["ate_m"] < 1e-9 and errors["within_3_std"] == 1.0
    turned = Estimate(found.poses, found.published + [0.0, 0.0, 1.0], found.covariances)
    assert errors_of(turned, truth)["within_3_std"] == 0.0
