"""Ranges that a driver gives where nothing came back: one value again and again, with nothing just behind it.

A wall piles ranges up, too, where it is straight across the rays and the ranges are rounded. But a wall goes on behind
its nearest point: the next values are there as well. Behind a value that means "no return" there is a gap.

A value that jitters is no single number. What stands alone in the room is as narrow a pile in one scan, but has other
ranges from other places, which a value that means "no return" has not.
"""

import math
from collections import Counter, deque
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.planar_motion import Array, compose
from ngo_recordings.scan_stream import LidarScan

Ranges = NDArray[np.float32]

_BEHIND_M = 0.1
_LEAST_GAP = 0.25
"""Ranges within ``_BEHIND_M`` behind a value, per range of the value, below which there is a gap."""

_JITTER_M = 0.04
"""From the least to the largest range of a value that jitters."""

_JITTERS_FROM_M = 1.0
"""Nearer, the robot itself has the same range from all places."""

_SHARE = 0.01
_TOP_SHARE = 0.03
"""Of the ranges; of an exact value that is the largest of its scan a few scans suffice."""

_FEWEST = 5
_SCANS = 8
_TOP_SCANS = 3
_KEPT = 16
"""Scans from different places in which a value is looked for."""

_CHANGED_M, _CHANGED_SHARE = 0.05, 0.5
"""A scan is from another place where so many ranges changed by so much."""

_APART_M = 0.5
"""Between places from which a value that jitters is looked for: over all, what stands beside the way is nearer or
farther by more than the jitter."""


class NoReturnValues:
    """Learns such values, and takes their ranges for what they are."""

    def __init__(self) -> None:
        self.values: list[float] = []
        """The values that are known, m."""
        self._bands = np.zeros((0, 2), np.float32)  # of ranges that mean these values
        self._exact: deque[list[float]] = deque(maxlen=_KEPT)
        self._jittered: deque[list[float]] = deque(maxlen=_KEPT)
        self._tops: Counter[float] = Counter()
        self._scan = np.zeros(0, np.float32)
        self._pose, self._counted = np.zeros(3), np.full(3, np.inf)

    def moved(self, step: Array) -> None:
        """Take the robot's motion ``(3,)`` since the scan before."""
        self._pose = compose(self._pose, step)

    def clean(self, scan: LidarScan) -> LidarScan:
        """The scan with no return in the place of these values.

        The largest becomes ``range_max`` where nothing was seen beyond it: up to there all is free. Of another one
        nothing is known but that it is no range.
        """
        self._learn(scan)
        if not self.values:
            return scan
        ranges, (least, largest) = scan.ranges, self._bands[-1]
        usual = np.isfinite(ranges) & (ranges < (scan.range_max if scan.range_max > 0.0 else math.inf))
        range_max = scan.range_max
        if not (usual & (ranges > largest)).any():
            range_max = float(least)
        low, high = self._bands[:, :1], self._bands[:, 1:]
        unknown = ((ranges >= low) & (ranges <= high)).any(axis=0) & usual & (ranges < range_max)
        if unknown.any():
            ranges = np.where(unknown, np.float32(np.nan), ranges)
        return replace(scan, ranges=ranges, range_max=range_max)

    def _learn(self, scan: LidarScan) -> None:
        ranges = np.array(scan.ranges, np.float32)
        largest = scan.range_max if scan.range_max > 0.0 else math.inf
        exact, at_top = _piled(ranges, max(scan.range_min, 0.0), largest, 0.0)
        if at_top:
            self._tops[float(exact[-1])] += 1
        if len(self._scan) != len(ranges) or _changed(self._scan, ranges):
            self._scan = ranges
            self._exact.append(exact.tolist())
        for value in exact.tolist():
            if sum(value in values for values in self._exact) >= _SCANS or self._tops[value] >= _TOP_SCANS:
                self._know(value, 0.0)
        if math.hypot(*(self._pose - self._counted)[:2]) < _APART_M:
            return
        self._counted = self._pose
        self._jittered.append(_piled(ranges, max(scan.range_min, _JITTERS_FROM_M), largest, _JITTER_M)[0].tolist())
        for value in self._jittered[-1]:
            near = [other for values in self._jittered for other in values if abs(other - value) < 0.5 * _JITTER_M]
            if len(near) >= _SCANS:
                self._know(round(float(np.mean(near)), 2), _JITTER_M)

    def _know(self, value: float, jitter: float) -> None:
        low, high = self._bands.T
        if not ((low <= value) & (value <= high)).any():
            self.values = sorted([*self.values, value])
            band = np.array([[value - jitter, value + jitter]], np.float32)
            self._bands = np.sort(np.append(self._bands, band, 0), 0)


@njit(cache=True)
def _piled(ranges: Ranges, least: float, largest: float, width: float) -> tuple[Ranges, bool]:
    """Values that pile up in a scan within a ``width`` (m), with nothing just behind them, and where there is a width
    just before them; and whether many have the largest of all."""
    usual = np.sort(ranges[np.isfinite(ranges) & (ranges > least) & (ranges < largest)])
    found, total = np.empty(0, ranges.dtype), len(usual)
    at_top = False
    begin = 0
    while total >= 4 * _FEWEST and begin < total:
        end = begin + 1
        while end < total and usual[end] <= usual[begin] + np.float32(width):
            end += 1
        count = end - begin
        piled = False
        if count >= max(_FEWEST, _SHARE * total):
            before, behind = begin, end
            while behind < total and usual[behind] <= usual[end - 1] + np.float32(_BEHIND_M):
                behind += 1
            while width > 0.0 and before > 0 and usual[before - 1] >= usual[begin] - np.float32(_BEHIND_M):
                before -= 1
            piled = max(behind - end, begin - before) < _LEAST_GAP * count
        if piled:
            found = np.append(found, usual[begin + count // 2])
            at_top = end == total and count >= _TOP_SHARE * total
        begin = end if piled or width == 0.0 else begin + 1
    return found, at_top


@njit(cache=True)
def _changed(before: Ranges, after: Ranges) -> bool:
    both, changed = 0, 0
    for k in range(len(before)):
        if math.isfinite(before[k]) and math.isfinite(after[k]):
            both += 1
            changed += abs(before[k] - after[k]) > np.float32(_CHANGED_M)
    return both == 0 or changed >= _CHANGED_SHARE * both
