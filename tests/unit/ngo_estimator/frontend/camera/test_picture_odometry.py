"""Odometry of pictures where they, or the wheels, tell nothing."""

import numpy as np
import pytest

from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
from tests.unit.ngo_estimator.rendered_room import by_wheels, camera, drive, picture, rays_of

PERIOD_NS = 100_000_000


@pytest.mark.parametrize("black", [range(3), range(4, 6)])
def test_black_pictures_go_on_by_wheels(black: range) -> None:
    model, truth = camera(160), drive(10)
    rays, wheels = rays_of(model), by_wheels(truth)
    odometry = PictureOdometry(model)
    inliers = []
    for k, pose in enumerate(truth):
        seen = picture(model, rays, pose)
        odometry.add_wheels(k * PERIOD_NS, wheels[k])
        odometry.add_picture(k * PERIOD_NS, np.zeros_like(seen) if k in black else seen)
        assert len(list(odometry.ready())) == (k > 0)
        inliers.append(odometry.inliers)
    assert not any(inliers[k] for k in black) and inliers[-1] > 20
    assert odometry.by_wheels == len([k for k in range(1, 10) if k in black or k - 1 in black])
