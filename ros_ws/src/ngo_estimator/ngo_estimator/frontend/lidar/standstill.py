"""Whether the robot stands, by the ranges alone.

Not in the paper. In a corridor no registration tells a robot that stands from one that drives along it. But the ranges
at doors, and of rays that graze the walls, change when it drives or turns a little: over a second most of them do.
"""

import math
from collections import deque

import numpy as np

from ngo_estimator.geometry.planar_motion import Array
from ngo_recordings.scan_stream import LidarScan

_AGO_NS = 1_000_000_000
"""Age of the scan that the newest is compared with."""

_UNCHANGED = 0.9
"""Share of the ranges; people walk past the others."""

_DEVIATIONS = 3.0
"""Of the noise of a change, within which a range counts as unchanged."""

_LEAST_NOISE_M = 0.005

_FEWEST = 15
"""Ranges without which nothing is said."""

_SLOW_M_S = 1.0
"""A robot of at most this speed may have braked since the walls told it."""

_NOISE_OF_BENDS = 1.0 / (0.6745 * math.sqrt(6.0))
"""The deviation of a range, from the median size of the second differences between neighbours."""


class StandstillDetector:
    """Compares each scan with one of a second before; keeps the scans of this second."""

    def __init__(self) -> None:
        self._scans: deque[tuple[int, Array]] = deque()

    def stands(self, scan: LidarScan) -> bool:
        """Take the newest scan: does it show what one showed a second ago, or more where there was none since?"""
        largest = 0.99 * scan.range_max if scan.range_max > 0.0 else math.inf
        usable = (scan.ranges > max(scan.range_min, 0.0)) & (scan.ranges < largest)
        ranges = np.where(usable, scan.ranges, np.nan).astype(np.float64)
        self._scans.append((scan.stamp_ns, ranges))
        until_ns = scan.stamp_ns - _AGO_NS
        while len(self._scans) > 1 and self._scans[1][0] <= until_ns:
            self._scans.popleft()
        before_ns, before = self._scans[0]
        if before_ns > until_ns or len(before) != len(ranges):
            return False
        changes, bends = np.abs(ranges - before), np.abs(ranges[2:] - 2.0 * ranges[1:-1] + ranges[:-2])
        changes, bends = changes[np.isfinite(changes)], bends[np.isfinite(bends)]
        if min(len(changes), len(bends)) < _FEWEST:
            return False
        noise_m = max(_NOISE_OF_BENDS * float(np.median(bends)), _LEAST_NOISE_M)
        return float((changes <= _DEVIATIONS * math.sqrt(2.0) * noise_m).mean()) >= _UNCHANGED


class StandstillBelief:
    """Whether scans that look as if the robot stands are believed.

    A corridor may show nothing at all. So a second that looks so is believed only where the robot may have braked
    before it; if it cannot have, what follows is not believed either, until something changes.
    """

    def __init__(self, acceleration_m_s2: float) -> None:
        self._acceleration = acceleration_m_s2
        self._told_ns, self._speed = 0, 0.0
        self._believed: bool | None = None  # since the scans look so

    def observe(self, stamp_ns: int, speed: float) -> None:
        """Walls told the speed (m/s)."""
        self._told_ns, self._speed = stamp_ns, speed

    def stands(self, stamp_ns: int, looks_so: bool) -> bool:
        """Whether the robot stands, where its newest scan looks so or not."""
        if not looks_so:
            self._believed = None
        elif self._believed is None:
            braked_s = max(stamp_ns - _AGO_NS - self._told_ns, 0) * 1e-9
            self._believed = self._speed <= _SLOW_M_S + self._acceleration * braked_s
        return bool(self._believed)
