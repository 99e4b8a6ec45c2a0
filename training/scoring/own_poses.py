"""Where an exploring robot believes that it is, and its map, by both estimators of a lidar: as the nodes compute it."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import compose, transformed
from ngo_estimator.mapping.occupancy_grid import OccupancyMap
from ngo_estimator.mapping.scan_map import ScanMap
from ngo_estimator.mapping.scan_source import KeyScans
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import WheelPose
from training.data.explored_worlds import Sight
from training.data.lidar_drives import TruePoses
from training.scoring.lidar_errors import covariance_errors, lidar_errors


class OwnPoses:
    """Takes scans and wheels, and knows pose and map in the frame of the world, by the first pose that it is told."""

    def __init__(self, weights: Path, first_xyyaw: np.ndarray) -> None:
        """weights: folder of the lidar's settings. The scanner sits in the robot's middle."""
        self._first = np.array(first_xyyaw)
        self._odometry, self._online = MixtureLidar.load(weights), ScanTrajectory.load(weights)
        self._source, self._map = KeyScans(), ScanMap()
        self._covariances = [np.zeros((3, 3))]
        self.pose_xyyaw, self.stamp_ns = self._first, 0

    def take(self, sight: Sight) -> None:
        """Take what was measured, in order of time."""
        for record in sight.records:
            if isinstance(record, WheelPose):
                self._odometry.add_wheels(record.stamp_ns, record.pose_xyyaw)
            else:
                with suppress(ValueError):  # a scan that is of no use is left out, as by the node
                    self._odometry.add_scan(record)
        for step in self._odometry.ready(False):
            update = self._online.update(step)
            self._covariances.append(update.covariance)
            self._map.take(step, self._source.scans(step))
            self.pose_xyyaw, self.stamp_ns = compose(self._first, update.pose_xyyaw), step.stamp_ns

    def cells(self) -> OccupancyMap:
        """The map so far, of all scans at the poses that are known now."""
        trajectory = self._online.trajectory()
        if trajectory is not None:
            self._map.update(trajectory.stamps_ns, _placed(self._first, trajectory.poses_xyyaw))
        return self._map.cells()

    def aligned_cells(self, truth: TruePoses) -> OccupancyMap:
        """The map after the rigid motion that brings the trajectory nearest to the truth, as for ``ate_m``."""
        trajectory = self._online.trajectory()
        if trajectory is None:
            return self._map.cells()
        own = trajectory.poses_xyyaw[:, :2]
        true = np.column_stack(
            [np.interp(trajectory.stamps_ns, truth.stamps_ns, truth.poses_xyyaw[:, i]) for i in (0, 1)]
        )
        (x, y), (true_x, true_y) = (own - own.mean(axis=0)).T, (true - true.mean(axis=0)).T
        yaw = np.arctan2((x * true_y - y * true_x).sum(), (x * true_x + y * true_y).sum())
        turned = transformed(np.array((0.0, 0.0, yaw)), own)
        first = np.array((*(true.mean(axis=0) - turned.mean(axis=0)), yaw))
        self._map.update(trajectory.stamps_ns, _placed(first, trajectory.poses_xyyaw))
        return self._map.cells()

    def errors(self, truth: TruePoses) -> dict[str, float]:
        """``ate_m`` of the whole trajectory as it is now, after the best rigid alignment, and ``within``.

        That is the share of the poses that were within three of their deviations when they were the newest.
        """
        trajectory = self._online.trajectory()
        if trajectory is None:
            return {}
        stamps_ns = trajectory.stamps_ns
        covariances = np.stack(self._covariances)
        within = covariance_errors(truth, stamps_ns, trajectory.online_xyyaw, covariances)["within_three_deviations"]
        ate_m = lidar_errors(truth, stamps_ns, trajectory.poses_xyyaw)["ate_m"]
        return {"ate_m": float(ate_m[0]), "within": float(within[0])}


def _placed(first: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses ``(n, 3)`` that are seen from ``first``, in its frame."""
    return np.column_stack((transformed(first, poses[:, :2]), first[2] + poses[:, 2]))
