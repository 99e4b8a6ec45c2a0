"""Ranges that a driver gives where nothing came back: one value again and again, with nothing just behind it.

A wall piles ranges up, too, where it is straight across the rays and the ranges are rounded. But a wall goes on behind
its nearest point: the next values are there as well. Behind a value that means "no return" there is a gap.
"""

import math
from collections import Counter, deque
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_recordings.scan_stream import LidarScan

Ranges = NDArray[np.float32]

_BEHIND_M = 0.1
_LEAST_GAP = 0.25
"""Ranges within ``_BEHIND_M`` behind a value, per range of the value, below which there is a gap."""

_SHARE = 0.01
_TOP_SHARE = 0.03
"""Of the ranges; of a value that is the largest of its scan a few scans suffice."""

_FEWEST = 5
_SCANS = 8
_TOP_SCANS = 3
_KEPT = 16
"""Scans from different places in which a value is looked for."""

_CHANGED_M, _CHANGED_SHARE = 0.05, 0.5
"""A scan is from another place where so many ranges changed by so much."""


class NoReturnValues:
    """Learns such values, and takes their ranges for what they are."""

    def __init__(self) -> None:
        self.values: list[float] = []
        """The values that are known, m."""
        self._piled: deque[tuple[float, ...]] = deque(maxlen=_KEPT)
        self._tops: Counter[float] = Counter()
        self._place = np.zeros(0, np.float32)

    def clean(self, scan: LidarScan) -> LidarScan:
        """The scan with no return in the place of these values.

        The largest becomes ``range_max`` where nothing was seen beyond it: up to there all is free. Of another one
        nothing is known but that it is no range.
        """
        self._learn(scan)
        if not self.values:
            return scan
        ranges, largest = scan.ranges, self.values[-1]
        usual = np.isfinite(ranges) & (ranges < (scan.range_max if scan.range_max > 0.0 else math.inf))
        range_max = scan.range_max
        if not (usual & (ranges > largest)).any():
            range_max = largest
        unknown = np.isin(ranges, np.array(self.values, np.float32)) & usual & (ranges < range_max)
        if unknown.any():
            ranges = np.where(unknown, np.float32(np.nan), ranges)
        return replace(scan, ranges=ranges, range_max=range_max)

    def _learn(self, scan: LidarScan) -> None:
        ranges = np.array(scan.ranges, np.float32)
        largest = scan.range_max if scan.range_max > 0.0 else math.inf
        values, at_top = _piled(ranges, max(scan.range_min, 0.0), largest)
        found = values.tolist()
        if at_top:
            self._tops[found[-1]] += 1
        if self._is_elsewhere(ranges):
            self._piled.append(tuple(found))
        if not found:
            return
        seen = Counter(value for values in self._piled for value in values)
        for value in found:
            if value not in self.values and (seen[value] >= _SCANS or self._tops[value] >= _TOP_SCANS):
                self.values = sorted([*self.values, value])

    def _is_elsewhere(self, ranges: Ranges) -> bool:
        if len(self._place) == len(ranges) and not _changed(self._place, ranges):
            return False
        self._place = ranges
        return True


@njit(cache=True)
def _piled(ranges: Ranges, least: float, largest: float) -> tuple[Ranges, bool]:
    """Values that pile up in a scan, with nothing just behind them; and whether many have the largest of all."""
    usual = np.sort(ranges[np.isfinite(ranges) & (ranges > least) & (ranges < largest)])
    found, total = np.empty(0, ranges.dtype), len(usual)
    at_top = False
    begin = 0
    while total >= 4 * _FEWEST and begin < total:
        end = begin + 1
        while end < total and usual[end] == usual[begin]:
            end += 1
        count = end - begin
        if count >= max(_FEWEST, _SHARE * total):
            behind = end
            while behind < total and usual[behind] <= usual[begin] + np.float32(_BEHIND_M):
                behind += 1
            if behind - end < _LEAST_GAP * count:
                found = np.append(found, usual[begin])
                at_top = end == total and count >= _TOP_SHARE * total
        begin = end
    return found, at_top


@njit(cache=True)
def _changed(before: Ranges, after: Ranges) -> bool:
    both, changed = 0, 0
    for k in range(len(before)):
        if math.isfinite(before[k]) and math.isfinite(after[k]):
            both += 1
            changed += abs(before[k] - after[k]) > np.float32(_CHANGED_M)
    return both == 0 or changed >= _CHANGED_SHARE * both
