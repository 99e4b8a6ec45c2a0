"""The graph leaves the odometry of unfamiliar frames as it is, and closes no loops with them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ngo_estimator.odometry.local_odometry import LocalOdometry
from ngo_estimator.online.online_trajectory import OnlineTrajectory
from tests.golden.drives import WEIGHTS, WORLDS, GoldenDrive, corrected, estimates


@pytest.mark.parametrize("world", WORLDS)
def test_what_is_unfamiliar_is_left_to_the_odometry(world: str) -> None:
    torch.set_num_threads(1)
    steps = estimates(GoldenDrive.load(world), LocalOdometry.load(WEIGHTS / world))
    core = OnlineTrajectory.load(WEIGHTS / world, world=world)
    unfamiliar = [replace(step, unlikeness=2.0) for step in steps]
    trajectory, update = corrected(unfamiliar, core)
    np.testing.assert_allclose(trajectory.poses_xyyaw[1:], trajectory.odometry_xyyaw[1:], atol=1e-4)
    assert update.closed_loops == 0
    # What is told of the deviations is published, whatever factor fits familiar frames.
    core.reset()
    _, familiar = corrected([replace(step, unlikeness=0.0) for step in steps], core)
    assert update.covariance[0, 0] > familiar.covariance[0, 0]


def test_a_session_with_unfamiliar_frames_goes_on_to_the_last_bit() -> None:
    torch.set_num_threads(1)
    steps = estimates(GoldenDrive.load("maze3d"), LocalOdometry.load(WEIGHTS / "maze3d"))
    steps = [replace(step, unlikeness=2.0 if 90 < k < 110 else 0.0) for k, step in enumerate(steps)]
    original = OnlineTrajectory.load(WEIGHTS / "maze3d", 200, "maze3d", 8, 1)
    for step in steps[:120]:
        original.update(step)
    loaded = original.restored(original.state())
    for step in steps[120:]:
        np.testing.assert_array_equal(original.update(step).pose_xyyaw, loaded.update(step).pose_xyyaw)
