"""Ranges or limits that a driver gives in another unit: no scanner sees so far, or hardly within its limits."""

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
_SPREAD = 1.1
"""Ratio of the ranges of nearly all rays: where it is less, nothing came back, by a value that jitters."""

_METRES = np.float32(0.001)


class RangeUnit:
    """Finds out, and gives scans in metres."""

    def __init__(self) -> None:
        self.millimetres = False
        """Whether ranges are in millimetres."""
        self._doubted = self._beyond = 0

    def metres(self, scan: LidarScan) -> LidarScan:
        """The scan in metres, also its limits where these are not."""
        near, far = _nearly_all(scan.ranges)
        doubted = 0.0 < far < _FAR if self.millimetres else near > _FAR
        self._doubted = self._doubted + 1 if doubted else 0
        if self._doubted >= _SCANS:
            self.millimetres, self._doubted = not self.millimetres, 0
        low, high = scan.range_min, scan.range_max
        if not self.millimetres:
            if self._beyond < _SCANS:
                beyond = _LEAST_LIMIT_M < low > far > 0.0 or 0.0 < high < near < far / _SPREAD
                self._beyond = self._beyond + 1 if beyond else 0
            return scan if self._beyond < _SCANS else replace(scan, range_min=0.0, range_max=0.0)
        low = 0.001 * low if low > _LEAST_LIMIT_M else low
        high = 0.001 * high if high > max(near, _FAR) else high
        return replace(scan, ranges=scan.ranges * _METRES, range_min=low, range_max=high)

    def remark(self) -> str:
        """In words; nothing where ranges and limits are in metres."""
        if self.millimetres:
            return "its ranges are in millimetres: taken so"
        return "nearly all it measures is beyond its limits: they are not used" if self._beyond >= _SCANS else ""


def _nearly_all(ranges: np.ndarray) -> tuple[float, float]:
    """Between which nearly all ranges lie; 0 and 0 where these are few, or alike."""
    seen = ranges[np.isfinite(ranges) & (ranges > 0.0)]
    if len(seen) < _FEWEST or len(np.unique(seen)) < _DISTINCT * len(seen):
        return 0.0, 0.0
    least = round(_NEARLY_ALL * len(seen))
    near, far = np.partition(seen, (least, len(seen) - 1 - least))[[least, -1 - least]]
    return float(near), float(far)
