"""The shipped weights correct a stored drive as they did when they were stored.

A checkpoint that is broken, exchanged or read wrongly fails here, and so does a change of the estimator that changes
its results. ``tests.golden.make_drives`` makes the stored files anew.
"""

import functools

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.odometry.local_odometry import LocalOdometry
from ngo_estimator.online.online_trajectory import OnlineTrajectory
from tests.golden.drives import WEIGHTS, WORLDS, GoldenDrive, corrected, estimates, position_rmse

# Processors round differently: with AVX-512, AVX2 and neither, poses differ by up to 4 um and 1 urad. The rest is for
# other versions of the libraries.
TOLERANCE_M, TOLERANCE_RAD = 0.001, 0.001


@functools.cache
def golden(world: str) -> tuple[GoldenDrive, list[RelativeStep]]:
    """A stored drive, and the odometry that the shipped local network makes of it."""
    drive = GoldenDrive.load(world)
    return drive, estimates(drive, LocalOdometry.load(WEIGHTS / world, world))


def largest_difference(poses: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) between two trajectories."""
    difference = poses - expected
    angle = np.remainder(difference[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return float(np.hypot(difference[:, 0], difference[:, 1]).max()), float(np.abs(angle).max())


@pytest.mark.parametrize("world", WORLDS)
def test_shipped_weights_correct_a_stored_drive_as_before(world: str) -> None:
    drive, steps = golden(world)
    trajectory, update = corrected(steps, OnlineTrajectory.load(WEIGHTS / world, world=world))
    assert update.closed_loops > 0
    assert position_rmse(trajectory.poses_xyyaw, drive.truth) < 0.5 * position_rmse(
        trajectory.odometry_xyyaw, drive.truth
    )
    distance_m, angle_rad = largest_difference(trajectory.poses_xyyaw, drive.poses)
    assert distance_m < TOLERANCE_M and angle_rad < TOLERANCE_RAD
    np.testing.assert_allclose(update.covariance, drive.covariance, rtol=0.05, atol=0.02 * drive.covariance.max())


@pytest.mark.parametrize("network", ["optimizer", "pair head"])
def test_a_stored_drive_tells_other_weights(network: str) -> None:
    drive, steps = golden("scan")
    optimizer, pair_head = load_optimizer(WEIGHTS / "scan")[0], load_place(WEIGHTS / "scan")[0].pair_head
    changed: torch.nn.Module = optimizer if network == "optimizer" else pair_head
    with torch.no_grad():
        for parameter in changed.parameters():
            parameter.mul_(1.1)
    trajectory, _ = corrected(steps, OnlineTrajectory(optimizer, pair_head))
    distance_m, angle_rad = largest_difference(trajectory.poses_xyyaw, drive.poses)
    assert distance_m > 2.0 * TOLERANCE_M or angle_rad > 2.0 * TOLERANCE_RAD
