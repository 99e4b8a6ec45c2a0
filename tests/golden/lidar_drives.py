"""Stored drives of lidars through simulated buildings."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.offline.lidar_run import LidarRun
from ngo_estimator.offline.recorded import RecordedStep
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import LidarScan, WheelPose
from ngo_sim.building2d import BuildingDrive
from tests.golden.net import JITTER, STORED, WEIGHTS, Run, save_arrays
from training.data.lidar_drives import LidarDrive, TruePoses, simulated_stamps_ns

SHIPPED = WEIGHTS / "scan"
_FARTHEST_M = 65.0  # that the file can hold, in mm


@dataclass(frozen=True, eq=False)
class GoldenLidarDrive:
    """A drive of ``n`` scans through a building.

    ``ranges_m`` ``(n, rays)`` float32 in whole mm, infinite without a return, at ``stamps_ns`` ``(n,)``. ``scanner``
    ``(5,)``: the first ray's angle, the increment (rad), the shortest and the longest range (m), and the time from ray
    to ray (s). ``mounting`` ``(4,)``: x, y, yaw on the robot, and 1 if upside down. ``wheel_poses`` ``(k, 3)`` in the
    wheels' frame at ``wheel_stamps_ns`` ``(k,)``, none without wheels. ``truth`` ``(n, 3)`` in the building's frame.
    """

    ranges_m: np.ndarray
    stamps_ns: np.ndarray
    scanner: np.ndarray
    mounting: np.ndarray
    wheel_poses: np.ndarray
    wheel_stamps_ns: np.ndarray
    truth: np.ndarray

    @classmethod
    def of(cls, drive: BuildingDrive, with_wheels: bool) -> GoldenLidarDrive:
        """A simulated drive as it is stored."""
        scanner = drive.scanner
        ranges_m = np.round(drive.ranges_m, 3)
        no_return = ~((ranges_m > 0.0) & (ranges_m <= min(scanner.range_max_m, _FARTHEST_M)))
        increment_rad = scanner.increment_rad * (1.0 + scanner.increment_error)
        limits = scanner.range_min_m, scanner.range_max_m, scanner.time_increment_s
        laser = scanner.laser_x_m, scanner.laser_y_m, math.radians(scanner.laser_yaw_deg), scanner.upside_down
        kept = slice(None if with_wheels else 0)
        return cls(
            np.where(no_return, np.inf, ranges_m).astype(np.float32),
            simulated_stamps_ns(drive.stamps_s),
            np.array((scanner.angles_rad[0], increment_rad, *limits)),
            np.array(laser),
            drive.wheel_poses_xyyaw[kept].astype(np.float32),
            simulated_stamps_ns(drive.wheel_stamps_s)[kept],
            drive.true_poses_xyyaw.astype(np.float32),
        )

    @classmethod
    def load(cls, name: str) -> GoldenLidarDrive:
        """The stored drive of a name."""
        with np.load(STORED / f"{name}.npz") as stored:
            arrays = {field.name: stored[field.name] for field in fields(cls)}
        ranges_mm = arrays["ranges_m"]
        return cls(**{**arrays, "ranges_m": np.where(ranges_mm > 0, ranges_mm / 1000.0, np.inf).astype(np.float32)})

    def save(self, name: str) -> None:
        """Store the drive under a name, the ranges in mm."""
        ranges_mm = np.rint(np.where(np.isfinite(self.ranges_m), self.ranges_m, 0.0) * 1000.0).astype(np.uint16)
        save_arrays(STORED / f"{name}.npz", {**vars(self), "ranges_m": ranges_mm})

    @property
    def true_poses(self) -> TruePoses:
        """The truth at the scans' stamps."""
        return TruePoses(self.stamps_ns, self.truth.astype(np.float64))

    def copy(self, seed: int) -> GoldenLidarDrive:
        """The drive with ranges that differ by up to ``JITTER``."""
        jitter = np.random.default_rng(seed).uniform(-JITTER, JITTER, self.ranges_m.shape)
        return replace(self, ranges_m=(self.ranges_m + jitter).astype(np.float32))

    def run(self, weights: Path = SHIPPED) -> Run:
        """Both estimators over the drive, with the settings in a folder."""
        first, increment, shortest, longest, from_ray_to_ray_s = self.scanner.tolist()
        scans = tuple(
            LidarScan(stamp_ns, first, increment, ranges, shortest, longest, from_ray_to_ray_s, "laser")
            for stamp_ns, ranges in zip(self.stamps_ns.tolist(), self.ranges_m, strict=True)
        )
        wheels = tuple(map(WheelPose, self.wheel_stamps_ns.tolist(), self.wheel_poses.astype(np.float64)))
        mounting = Mounting(self.mounting[:3], bool(self.mounting[3]))
        drive = LidarDrive("golden", "golden", scans, wheels, mounting, self.true_poses)
        both = LidarRun(MixtureLidar.load(weights, "scan"), ScanTrajectory.load(weights, "scan"), mounting)
        covariances, update = [np.zeros((3, 3))], None
        for found in both.run(drive.records()):
            if isinstance(found, RecordedStep):
                update = found.update
                covariances.append(update.covariance)
            else:
                trajectory = found.trajectory
        assert update is not None and not both.faults, both.faults
        return Run(trajectory, np.stack(covariances), int((trajectory.loop_weights > 0.5).sum()))
