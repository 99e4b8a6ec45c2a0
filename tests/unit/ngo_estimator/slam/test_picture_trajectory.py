"""A camera's ways are counted by wheels: what these count wrong together, no picture tells."""

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.slam.picture_trajectory import PictureTrajectory

NOTHING = np.zeros(0, np.float32)


def test_a_pose_is_as_unsure_as_the_wheels_scale_is_at_its_distance() -> None:
    core, covariance = PictureTrajectory(), np.eye(3) * 1e-8
    for k in range(1, 101):
        step = np.array((0.1, 0.0, 0.0)), np.array((0.1 * k, 0.0, 0.0))
        update = core.update(RelativeStep(k, k - 1, step[0], covariance, 0, step[1], NOTHING, NOTHING))
    std = np.sqrt(np.diagonal(update.covariance))
    assert 0.02 * 10.0 < std[0] < 0.21 and std[1] < 0.02
