"""KISS-ICP (Vizzo et al. 2023) on a lidar's scans: it has neither wheels nor loops, and gets points with z = 0."""

import math
from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.configuration import check_positive
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan

_LEAST_POINTS = 3


@dataclass(frozen=True)
class KissConfig:
    """Settings of KISS-ICP that differ from its own; voxels and threshold were the best tried on validation buildings.

    ``voxel_m`` is the side of the map's voxels, ``range_m`` the longest range that is used, and ``threshold_m`` the
    first threshold of correspondences. Its deskewing is off.
    """

    voxel_m: float = 0.05
    range_m: float = 30.0
    threshold_m: float = 0.3

    def __post_init__(self) -> None:
        check_positive(self, "voxel_m range_m threshold_m")


def kiss_icp(scans: tuple[LidarScan, ...], mounting: Mounting, config: KissConfig) -> np.ndarray:
    """Poses ``(scans, 3)`` of the robot by KISS-ICP, the first at the origin; on one thread.

    Raises:
        ModuleNotFoundError: KISS-ICP is not installed.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    settings = KISSConfig()
    settings.data.max_range, settings.data.min_range, settings.data.deskew = config.range_m, 0.0, False
    settings.mapping.voxel_size = config.voxel_m
    settings.adaptive_threshold.initial_threshold = config.threshold_m
    settings.registration.max_num_threads = 1
    odometry = KissICP(settings)
    poses = np.zeros((len(scans), 3))
    for index, scan in enumerate(scans):
        points = scan_points(scan, mounting)
        if len(points) >= _LEAST_POINTS:  # where there are none the robot is taken to stand
            odometry.register_frame(np.pad(points, ((0, 0), (0, 1))), np.zeros(len(points)))
        pose = odometry.last_pose
        poses[index] = pose[0, 3], pose[1, 3], math.atan2(pose[1, 0], pose[0, 0])
    return poses


def scan_points(scan: LidarScan, mounting: Mounting) -> np.ndarray:
    """Ends ``(n, 2)`` of the rays that returned, in the robot's frame, as measured: no motion is removed."""
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ranges = scan.ranges.astype(np.float64)
    x, y, yaw = mounting.sensor_xyyaw
    limit = scan.range_max if scan.range_max > 0.0 else math.inf
    returned = np.isfinite(ranges) & (ranges > max(scan.range_min, 0.0)) & (ranges < limit)
    direction = yaw + (-angles if mounting.upside_down else angles)[returned]
    return np.stack((x + ranges[returned] * np.cos(direction), y + ranges[returned] * np.sin(direction)), axis=-1)
