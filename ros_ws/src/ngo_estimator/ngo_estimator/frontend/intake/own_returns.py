"""Rays that see the robot itself: a near range that stays while the robot drives and turns."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ngo_estimator.geometry.planar_motion import Array, compose
from ngo_recordings.scan_stream import LidarScan

Indices = NDArray[np.integer[Any]]

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
        self._own = np.zeros((0, self._cells), np.bool_)
        self._pose, self._counted = np.zeros(3), np.array((math.inf, 0.0, 0.0))
        self._waiting = False

    def moved(self, step: Array) -> None:
        """Take the robot's motion ``(3,)`` since the scan before."""
        self._pose = compose(self._pose, step)

    def clean(self, scan: LidarScan) -> Array:
        """The scan's ranges ``(rays,)``, those that end on the robot not numbers."""
        count = len(scan.ranges)
        if count != self._hits.shape[1]:  # rays have other directions now
            self._hits = np.zeros((_HEADINGS, count, self._cells), np.int32)
            self._own = np.zeros((count, self._cells), np.bool_)
            self._scans[:] = 0
        near = (scan.ranges > max(scan.range_min, 0.0)) & (scan.ranges < _FARTHEST_M - _CELL_M)
        rays = np.flatnonzero(near)
        cells = (scan.ranges[rays] / _CELL_M).astype(np.int64)
        self._count(rays, cells)
        if not self._own.any():
            return scan.ranges
        own = rays[self._own[rays, cells]]
        self.rays = len(own)
        ranges = scan.ranges.copy()
        ranges[own] = np.nan
        return ranges

    def _count(self, rays: Indices, cells: Indices) -> None:
        off = self._pose - self._counted
        turn = abs(math.remainder(off[2], math.tau))
        if math.hypot(off[0], off[1]) < _STEP_M and turn < _STEP_RAD:
            return
        self._counted = self._pose
        heading = int((self._pose[2] % math.tau) / math.tau * _HEADINGS) % _HEADINGS
        self._scans[heading] += 1
        if not len(rays):
            return
        self._hits[heading, rays, cells] += 1
        total = int(self._scans.sum())
        if total < _FEWEST:
            return
        # A range beside a cell's border falls to either side: two neighbours count as one.
        hits = self._hits[:, rays].astype(np.float64)
        hits[:, :, :-1] += self._hits[:, rays, 1:]
        counted = self._scans >= _PER_HEADING
        shares = hits[counted] / self._scans[counted, None, None]
        everywhere = hits.sum(axis=0) >= _SEEN * total
        turning = (shares >= _SEEN).sum(axis=0) >= _FEWEST_HEADINGS
        inside = (np.arange(self._cells) + 2) * _CELL_M <= _INSIDE_M
        own = everywhere & (turning | inside[None])
        own[:, 1:] |= own[:, :-1]
        self._own[rays] = own
