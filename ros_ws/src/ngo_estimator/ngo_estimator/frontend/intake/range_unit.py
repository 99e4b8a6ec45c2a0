"""Ranges that a driver gives in millimetres: nearly all of them would be farther than any scanner sees."""

from dataclasses import replace

import numpy as np

from ngo_recordings.scan_stream import LidarScan

_FAR_M = 150.0
"""No scanner of a robot sees so far in nearly all directions."""

_NEARLY_ALL = 0.1
"""Share of the ranges that may be nearer."""

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
        self._doubted = 0

    def metres(self, scan: LidarScan) -> LidarScan:
        """The scan in metres, also its limits where these hold the ranges."""
        least = _nearly_least(scan.ranges)
        if not self.millimetres:
            self._doubted = self._doubted + 1 if least > _FAR_M else 0
            self.millimetres = self._doubted >= _SCANS
        if not self.millimetres:
            return scan
        low, high = scan.range_min, scan.range_max
        if high > max(least, _FAR_M):
            low, high = 0.001 * low, 0.001 * high
        return replace(scan, ranges=scan.ranges * _METRES, range_min=low, range_max=high)

    def remark(self) -> str:
        """In words; nothing where ranges are in metres."""
        return "its ranges are in millimetres: taken so" if self.millimetres else ""


def _nearly_least(ranges: np.ndarray) -> float:
    """The range that nearly all others exceed; 0 where these are few, or alike."""
    seen = ranges[np.isfinite(ranges) & (ranges > 0.0)]
    if len(seen) < _FEWEST or len(np.unique(seen)) < _DISTINCT * len(seen):
        return 0.0
    return float(np.partition(seen, round(_NEARLY_ALL * len(seen)))[round(_NEARLY_ALL * len(seen))])
