"""Rays that see the robot itself: a near range that stays while the robot drives and turns."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.planar_motion import Array, compose
from ngo_recordings.scan_stream import LidarScan

Ranges = NDArray[np.float32]
Counts = NDArray[np.int32]

_CELL_M = 0.02
_FARTHEST_M = 1.0
"""No robot of a usual size sees itself farther away."""

_INSIDE_M = 0.2
"""Nearer than this to its scanner no robot drives along a wall."""

_STEP_M, _STEP_RAD = 0.1, 0.2
"""A scan from a place that is farther from the last one counted."""

_HEADINGS = 8
_SEEN = 0.5
"""Share of the scans in which a ray sees the robot: some rays see it at times."""

_FEWEST = 8
_FEWEST_HEADINGS = 3
"""A wall keeps its range while the robot drives along it, but not while it turns."""

_PER_HEADING = 4


class OwnReturns:
    """Learns which rays end on the robot, by scans from different places, and makes these ranges unknown."""

    def __init__(self) -> None:
        self.rays = 0
        """How many rays see the robot, by the last scan."""
        self._cells = round(_FARTHEST_M / _CELL_M)
        self._hits = np.zeros((_HEADINGS, 0, self._cells), np.int32)
        self._scans = np.zeros(_HEADINGS, np.int32)
        self._own, self._any = np.zeros((0, self._cells), np.bool_), False
        self._pose, self._counted = np.zeros(3), np.array((math.inf, 0.0, 0.0))

    def moved(self, step: Array) -> None:
        """Take the robot's motion ``(3,)`` since the scan before."""
        self._pose = compose(self._pose, step)

    def clean(self, scan: LidarScan) -> Ranges:
        """The scan's ranges ``(rays,)``, those that end on the robot not numbers."""
        count = len(scan.ranges)
        if count != self._hits.shape[1]:  # rays have other directions now
            self._hits = np.zeros((_HEADINGS, count, self._cells), np.int32)
            self._own, self._any = np.zeros((count, self._cells), np.bool_), False
            self._scans[:] = 0
        ranges, least = np.array(scan.ranges, np.float32), max(scan.range_min, 0.0)
        self._count(ranges, least)
        if not self._any:
            return scan.ranges
        self.rays = _left_out(ranges, least, self._own)
        return ranges

    def _count(self, ranges: Ranges, least: float) -> None:
        off = self._pose - self._counted
        turn = abs(math.remainder(off[2], math.tau))
        if math.hypot(off[0], off[1]) < _STEP_M and turn < _STEP_RAD:
            return
        self._counted = self._pose
        heading = int((self._pose[2] % math.tau) / math.tau * _HEADINGS) % _HEADINGS
        self._scans[heading] += 1
        self._any |= _learned(ranges, least, self._hits, self._scans, heading, self._own)


@njit(cache=True)
def _cell(value: float, least: float) -> int:
    """The cell of a range (m) that may be the robot's; -1 where it is too far, or none."""
    return int(value / np.float32(_CELL_M)) if least < value < _FARTHEST_M - _CELL_M else -1


@njit(cache=True)
def _left_out(ranges: Ranges, least: float, own: NDArray[np.bool_]) -> int:
    """Make the ranges that end on the robot no numbers; how many these are."""
    count = 0
    for ray in range(len(ranges)):
        cell = _cell(ranges[ray], least)
        if cell >= 0 and own[ray, cell]:
            ranges[ray] = np.nan
            count += 1
    return count


@njit(cache=True)
def _learned(ranges: Ranges, least: float, hits: Counts, scans: Counts, heading: int, own: NDArray[np.bool_]) -> bool:
    """Count a scan, and judge anew the rays that saw something near; whether one of these sees the robot."""
    total, cells = scans.sum(), own.shape[1]
    found = False
    for ray in range(len(ranges)):
        cell = _cell(ranges[ray], least)
        if cell < 0:
            continue
        hits[heading, ray, cell] += 1
        if total < _FEWEST:
            continue
        own[ray] = False
        for c in range(cells):
            seen, turning = 0, 0
            for h in range(_HEADINGS):
                # A range beside a cell's border falls to either side: two neighbours count as one.
                both = hits[h, ray, c] + (hits[h, ray, c + 1] if c + 1 < cells else 0)
                seen += both
                turning += scans[h] >= _PER_HEADING and both >= _SEEN * scans[h]
            if seen >= _SEEN * total and (turning >= _FEWEST_HEADINGS or (c + 2) * _CELL_M <= _INSIDE_M):
                own[ray, c : c + 2] = True
                found = True
    return found
