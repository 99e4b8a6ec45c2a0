"""Rays that meet the floor while the robot brakes, tilts or stands on a ramp, by an IMU that knows where up is.

A ray is left out where its end lies at the height of the floor below the tilted scanner. What ends higher is a wall,
and where a ray goes on below, the floor is not there. Walls that a wrong tilt puts at the height of the floor are left
out, too. Their ranges alone do not tell them from a floor.
"""

import math
from collections import deque
from dataclasses import replace

import numpy as np

from ngo_estimator.geometry.planar_motion import Array
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan

_KEPT = 400
_LONGEST_NS = 300_000_000
"""A tilt from so long before a scan says nothing of it."""

_LEVEL_S = 60.0
"""Robots are level in the mean over so long; the rest is the mounting of the IMU."""

_LEAST = math.sin(math.radians(1.0))
"""Metres down per metre from which a ray counts as tilted, and how well a tilt is known."""

_ABOVE_M, _BELOW_M = 0.05, 0.15
"""Ends so far above and below the floor are on it: a base frame is up to a wheel's radius above the floor."""

_LOWEST_M = 0.02
"""A scanner that is not higher has no known height."""


class FloorRays:
    """Takes up directions of the robot, and makes the ranges of scans that end on the floor unknown."""

    def __init__(self) -> None:
        self.count = 0
        """How many rays met the floor."""
        self._stamps: deque[int] = deque(maxlen=_KEPT)
        self._slopes: deque[Array] = deque(maxlen=_KEPT)
        self._level: Array | None = None

    def add(self, stamp_ns: int, up: Array) -> None:
        """Take the world's up in the robot's axes ``(3,)``; an older stamp than the last begins anew."""
        if self._stamps and stamp_ns == self._stamps[-1]:
            return
        if self._stamps and stamp_ns < self._stamps[-1]:
            self._stamps.clear()
            self._slopes.clear()
        elapsed_s = (stamp_ns - self._stamps[-1]) * 1e-9 if self._stamps else 0.0
        level = up[:2] if self._level is None else self._level
        self._level = level + min(elapsed_s / _LEVEL_S, 1.0) * (up[:2] - level)
        self._stamps.append(stamp_ns)
        self._slopes.append(up[:2] - self._level)

    def without(self, scan: LidarScan, mounting: Mounting) -> LidarScan:
        """The scan with no number for each ray that meets the floor."""
        stamps = self._stamps
        if not stamps or mounting.height_m < _LOWEST_M or not stamps[0] <= scan.stamp_ns <= stamps[-1] + _LONGEST_NS:
            return scan
        times_s = (np.array(stamps) - scan.stamp_ns) * 1e-9
        slopes = np.array(self._slopes)
        angles = mounting.sensor_xyyaw[2] + (-scan.angles if mounting.upside_down else scan.angles)
        ahead, left = (np.interp(scan.ray_offsets_s, times_s, slopes[:, axis]) for axis in (0, 1))
        down = -(ahead * np.cos(angles) + left * np.sin(angles))  # metres per metre
        with np.errstate(invalid="ignore"):  # infinite ranges
            height = mounting.height_m - down * scan.ranges
            unsure = _LEAST * scan.ranges
            floor = (down > _LEAST) & (height < _ABOVE_M + unsure) & (height > -_BELOW_M - unsure)
        if not floor.any():
            return scan
        self.count += int(floor.sum())
        return replace(scan, ranges=np.where(floor, np.float32(np.nan), scan.ranges))

    def remark(self) -> str:
        """In words; nothing where no ray met the floor."""
        return f"{self.count} rays met the floor while the robot was tilted: left out" if self.count else ""
