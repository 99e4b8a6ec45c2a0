"""Ranges or limits that a driver gives in another unit: no scanner sees so far, or hardly within its limits."""

import math
from dataclasses import replace

import numpy as np

from ngo_recordings.scan_stream import LidarScan

_FAR = 150.0
"""No scanner of a robot sees so far (m) in a tenth of all directions, nor so little (mm) in nearly all."""

_MIDDLE_CM = 1000.0
"""No room is so wide in centimetres: half of the ranges are below."""

_CM_LIMITS = (3.0, 500.0)
"""No scanner has a smallest range that is more in metres, together with a largest one; in centimetres it may."""

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

_NAMES = {0.001: "millimetres", 0.01: "centimetres"}


class RangeUnit:
    """Finds out, and gives scans in metres."""

    def __init__(self) -> None:
        self._unit_m = 1.0
        self._doubted = self._beyond = self._cropped = 0

    def metres(self, scan: LidarScan) -> LidarScan:
        """The scan in metres, also its limits where these are not."""
        near, middle, far = _nearly_all(scan.ranges)
        low, high = scan.range_min, scan.range_max
        found_m = 0.001 if near > _FAR else 1.0
        others = (low > _CM_LIMITS[0] and _CM_LIMITS[1] < high < math.inf) or 0.0 < high < near
        if others and far > _FAR >= near > 0.1 * _FAR:
            found_m = 0.01 if middle < _MIDDLE_CM else 0.001
        doubted = 0.0 < far * self._unit_m < 0.001 * _FAR if self._unit_m < 1.0 else found_m < 1.0
        self._doubted = self._doubted + 1 if doubted else 0
        if self._doubted >= _SCANS:
            self._unit_m, self._doubted = 1.0 if self._unit_m < 1.0 else found_m, 0
        if self._unit_m == 1.0:
            if self._beyond < _SCANS:
                beyond = _LEAST_LIMIT_M < low > far > 0.0 or 0.0 < high < near < far / _SPREAD
                self._beyond = self._beyond + 1 if beyond else 0
            if self._cropped < _SCANS:
                self._cropped = self._cropped + 1 if 0.0 < high < middle < far / _SPREAD else 0
            return scan if self._beyond < _SCANS else replace(scan, range_min=0.0, range_max=0.0)
        low = self._unit_m * low if low > _LEAST_LIMIT_M else low
        high = self._unit_m * high if high > max(near, _FAR) else high
        return replace(scan, ranges=scan.ranges * np.float32(self._unit_m), range_min=low, range_max=high)

    def remark(self) -> str:
        """In words; nothing where ranges and limits are in metres."""
        if self._unit_m < 1.0:
            return f"its ranges are in {_NAMES[self._unit_m]}: taken so"
        if self._beyond >= _SCANS:
            return "nearly all it measures is beyond its limits: they are not used"
        cropped = self._cropped >= _SCANS
        return "most of what it measures is beyond its range_max: not used" if cropped else ""


def _nearly_all(ranges: np.ndarray) -> tuple[float, float, float]:
    """Between which nearly all ranges lie, and the median between both; zeros where these are few, or alike."""
    seen = ranges[np.isfinite(ranges) & (ranges > 0.0)]
    if len(seen) < _FEWEST or len(np.unique(seen)) < _DISTINCT * len(seen):
        return 0.0, 0.0, 0.0
    least = round(_NEARLY_ALL * len(seen))
    order = least, len(seen) // 2, len(seen) - 1 - least
    near, middle, far = np.partition(seen, order)[list(order)].tolist()
    return near, middle, far
