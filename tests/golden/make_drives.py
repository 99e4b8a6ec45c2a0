"""Make the stored drives anew, after weights were trained anew: ``python -m tests.golden.make_drives [WORLD ...]``.

The frames come from the simulators, so this needs ViZDoom for ``maze3d``; the tests themselves do not.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

from ngo_estimator.odometry.local_odometry import LocalOdometry
from ngo_estimator.online.online_trajectory import OnlineTrajectory
from ngo_sim.episodes import record_episode
from tests.golden.drives import WEIGHTS, WORLDS, GoldenDrive, corrected, estimates, position_rmse
from training.data.streams import images_of
from training.data.worlds import world_named
from training.scoring.metrics import seen_from_first

# A seed of no training and no table, the frames, the rows of blocks and the extra openings of the maze. In each of
# these drives the robot comes back to a place it knows.
DRIVES = {
    "maze2d": (900_000_001, 320, 5, 4),
    "maze3d": (900_000_001, 208, 5, 4),
    "scan": (900_000_016, 400, 4, 4),
}


def make(world_name: str) -> GoldenDrive:
    """Drive, and let the shipped weights correct the odometry."""
    seed, frames, rows, extra_openings = DRIVES[world_name]
    world = world_named(world_name)
    environment = world.make(rows, extra_openings)
    try:
        episode = record_episode(environment, world.driver, frames, seed)
    finally:
        environment.close()
    images = images_of(world, episode).numpy()
    if images.dtype == np.uint8:
        images = (images & 0xF8) | 4  # 32 levels compress to half the size, and change nothing that matters
    drive = GoldenDrive(
        frames=images,
        actions=episode.actions,
        period_ns=np.array(round(world.period_s * 1e9)),
        truth=seen_from_first(episode.poses_xyyaw),
        poses=np.zeros((frames, 3)),
        covariance=np.zeros((3, 3)),
    )
    weights = WEIGHTS / world_name
    steps = estimates(drive, LocalOdometry.load(weights, world_name))
    trajectory, update = corrected(steps, OnlineTrajectory.load(weights, world=world_name))
    odometry_m, corrected_m = (
        position_rmse(p, drive.truth) for p in (trajectory.odometry_xyyaw, trajectory.poses_xyyaw)
    )
    print(f"{world_name}: {frames} frames, {update.closed_loops} loops, error {odometry_m:.3f} -> {corrected_m:.3f} m")
    return GoldenDrive(**{**vars(drive), "poses": trajectory.poses_xyyaw, "covariance": update.covariance})


if __name__ == "__main__":
    torch.set_num_threads(1)
    for name in sys.argv[1:] or WORLDS:
        make(name).save(name)
