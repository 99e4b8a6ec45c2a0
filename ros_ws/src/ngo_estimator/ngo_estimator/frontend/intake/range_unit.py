"""Ranges or limits that a driver gives in another unit: no scanner sees so far, or mostly beyond its limits."""

from dataclasses import replace

import numpy as np

from ngo_recordings.scan_stream import LidarScan

_FAR = 150.0
"""No scanner of a robot sees so far (m) in nearly all directions, nor so little (mm)."""

_LEAST_LIMIT_M = 1.0
"""A driver's smallest range is less; a larger number is in millimetres."""

_NEARLY_ALL = 0.1
"""Share of the ranges that may be nearer, or farther."""

_FEWEST = 20
_DISTINCT = 0.25
"""Share of the ranges that differ: a code for no return is one value."""

_SCANS = 3
_METRES = np.float32(0.001)


class RangeUnit:
    """Finds out, and gives scans in metres."""

    def __init__(self) -> None:
        self.millimetres = False
        """Whether ranges are in millimetres."""
        self._doubted = self._beyond = 0

    def metres(self, scan: LidarScan) -> LidarScan:
        """The scan in metres, also its limits where these are not."""
        near, middle, far = _quantiles(scan.ranges)
        doubted = 0.0 < far < _FAR if self.millimetres else near > _FAR
        self._doubted = self._doubted + 1 if doubted else 0
        if self._doubted >= _SCANS:
            self.millimetres, self._doubted = not self.millimetres, 0
        low, high = scan.range_min, scan.range_max
        if not self.millimetres:
            if not (_LEAST_LIMIT_M < low > far > 0.0 or 0.0 < high < middle):
                return scan
            self._beyond += 1
            return replace(scan, range_min=0.0, range_max=0.0)
        low = 0.001 * low if low > _LEAST_LIMIT_M else low
        high = 0.001 * high if high > max(near, _FAR) else high
        return replace(scan, ranges=scan.ranges * _METRES, range_min=low, range_max=high)

    def remark(self) -> str:
        """In words; nothing where ranges and limits are in metres."""
        if self.millimetres:
            return "its ranges are in millimetres: taken so"
        return "most of what it measures is beyond its limits: they are not used" if self._beyond >= _SCANS else ""


def _quantiles(ranges: np.ndarray) -> tuple[float, float, float]:
    """Between which nearly all ranges lie, with their median in the middle; 0 where these are few, or alike."""
    seen = ranges[np.isfinite(ranges) & (ranges > 0.0)]
    if len(seen) < _FEWEST or len(np.unique(seen)) < _DISTINCT * len(seen):
        return 0.0, 0.0, 0.0
    least = round(_NEARLY_ALL * len(seen))
    at = [least, len(seen) // 2, len(seen) - 1 - least]
    near, middle, far = np.partition(seen, at)[at].tolist()
    return near, middle, far
