"""A stored drive of a lidar with wheels, and the trajectory that the shipped settings make of it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ngo_estimator.frontend.lidar.lidar_odometry import LidarOdometry
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from ngo_recordings.scan_stream import LidarScan
from tests.golden.drives import FIRST_STAMP_NS, FOLDER

FILE = FOLDER / "scan.npz"


@dataclass(frozen=True, eq=False)
class GoldenLidarDrive:
    """A drive of ``n`` scans through a building, and the expected result.

    ``ranges_mm`` ``(n, rays)`` uint16, 0 without a return, of rays at ``first_rad`` () and ``increment_rad`` () apart,
    up to ``range_max_m`` (). ``wheel_poses`` ``(n, 3)`` in the wheels' frame at the scans' stamps, which are
    ``period_ns`` () apart. ``truth`` ``(n, 3)`` the true poses seen from the first scan (m, m, rad). ``poses``
    ``(n, 3)`` and ``covariance`` ``(3, 3)`` are the expected corrected poses and the covariance of the last one, in
    ``map``.
    """

    ranges_mm: np.ndarray
    first_rad: np.ndarray
    increment_rad: np.ndarray
    range_max_m: np.ndarray
    wheel_poses: np.ndarray
    period_ns: np.ndarray
    truth: np.ndarray
    poses: np.ndarray
    covariance: np.ndarray

    @classmethod
    def load(cls) -> GoldenLidarDrive:
        """The stored drive."""
        with np.load(FILE) as stored:
            return cls(**{field.name: stored[field.name] for field in fields(cls)})

    def save(self) -> None:
        """Store the drive."""
        np.savez_compressed(FILE, **vars(self))


def corrected_scans(drive: GoldenLidarDrive, weights: Path) -> tuple[Trajectory, TrajectoryUpdate]:
    """The finished trajectory of the drive with the settings in the folder ``weights``, and the last update."""
    odometry, online = LidarOdometry.load(weights, "scan"), ScanTrajectory.load(weights, "scan")
    geometry = float(drive.first_rad), float(drive.increment_rad)
    update = None
    for number, (ranges_mm, wheel_pose) in enumerate(zip(drive.ranges_mm, drive.wheel_poses, strict=True)):
        stamp_ns = FIRST_STAMP_NS + number * int(drive.period_ns)
        ranges_m = np.where(ranges_mm > 0, ranges_mm / 1000.0, np.inf).astype(np.float32)
        odometry.add_wheels(stamp_ns, wheel_pose)
        odometry.add_scan(LidarScan(stamp_ns, *geometry, ranges_m, 0.0, float(drive.range_max_m), 0.0, "laser"))
        for step in odometry.ready():
            update = online.update(step)
    update = online.finish() or update
    trajectory = online.trajectory()
    assert trajectory is not None and update is not None
    return trajectory, update
