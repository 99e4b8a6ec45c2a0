"""Make the stored drives anew, after weights or a lidar's settings changed.

    python -m tests.golden.make_drives [maze2d | maze3d | scan ...]

The frames come from the simulators, so this needs ViZDoom for ``maze3d``; the tests themselves do not.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_sim.building2d import Building2d
from ngo_sim.building_drivers import BuildingDriverConfig
from ngo_sim.episodes import record_episode
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.wheels import WheelsConfig
from tests.golden.drives import WEIGHTS, WORLDS, GoldenDrive, corrected, estimates, position_rmse
from tests.golden.lidar_drives import GoldenLidarDrive, corrected_scans
from training.data.streams import images_of
from training.data.worlds import world_named
from training.scoring.metrics import seen_from_first

# A seed of no training and no table, the frames, the rows of blocks and the extra openings of the maze. In each of
# these drives the robot comes back to a place it knows.
DRIVES = {
    "maze2d": (900_000_001, 320, 5, 4),
    "maze3d": (900_000_001, 208, 5, 4),
}
# The same for the lidar: the seed of the building and the scans.
BUILDING_SEED, SCANS = 900_000_001, 400


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


def make_scans() -> GoldenLidarDrive:
    """Drive round a ring of corridors with wheels that are wrong, and let the shipped settings correct the odometry."""
    scanner = ScannerConfig(
        rays=181, field_of_view_deg=180.0, range_max_m=8.0, scan_period_s=0.2, noise_m=0.02, resolution_m=0.001
    )
    recorded = Building2d(
        FloorPlanConfig(layout="ring", scale=0.5, people=1),
        scanner,
        WheelsConfig(left_bias=0.03, right_bias=-0.01),
        BuildingDriverConfig("patrol", stand=0.0, spin=0.0, speed_mps=1.0),
    ).record(BUILDING_SEED, length_m=1000.0, most_scans=SCANS)
    ranges_m = np.where(np.isfinite(recorded.ranges_m), recorded.ranges_m, 0.0)
    drive = GoldenLidarDrive(
        ranges_mm=np.rint(ranges_m * 1000.0).astype(np.uint16),
        first_rad=np.array(scanner.angles_rad[0]),
        increment_rad=np.array(scanner.increment_rad),
        range_max_m=np.array(scanner.range_max_m),
        wheel_poses=recorded.wheel_poses_xyyaw,
        period_ns=np.array(round(scanner.scan_period_s * 1e9)),
        truth=seen_from_first(recorded.true_poses_xyyaw),
        poses=np.zeros((SCANS, 3)),
        covariance=np.zeros((3, 3)),
    )
    trajectory, update = corrected_scans(drive, WEIGHTS / "scan")
    wheels_m, odometry_m, corrected_m = (
        position_rmse(p, drive.truth)
        for p in (seen_from_first(drive.wheel_poses), trajectory.odometry_xyyaw, trajectory.poses_xyyaw)
    )
    print(
        f"scan: {SCANS} scans, {update.closed_loops} loops, error of the wheels {wheels_m:.3f} m, "
        f"{odometry_m:.3f} -> {corrected_m:.3f} m"
    )
    return GoldenLidarDrive(**{**vars(drive), "poses": trajectory.poses_xyyaw, "covariance": update.covariance})


if __name__ == "__main__":
    torch.set_num_threads(1)
    for name in sys.argv[1:] or (*WORLDS, "scan"):
        if name == "scan":
            make_scans().save()
        else:
            make(name).save(name)
