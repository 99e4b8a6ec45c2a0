"""The rays of one frame as a map takes them: where they begin, where they end, and whether a surface is there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RangeScan:
    """Rays in the robot's base frame (m).

    ``sensor_xyyaw`` ``(3,)`` is the sensor's pose, where all rays begin. ``ends`` ``(n, 2)`` is where they end, and
    ``hits`` ``(n,)`` whether a surface is there: other rays were cut at the largest range.
    """

    sensor_xyyaw: Array
    ends: NDArray[np.float32]
    hits: NDArray[np.bool_]

    @property
    def reach_m(self) -> float:
        """Mean length of the rays: how far a turn by one rad moves what they saw."""
        return float(np.hypot(*(self.ends - self.sensor_xyyaw[:2]).T).mean()) if len(self.ends) else 0.0


def range_scan(angles: Array, ranges: Array, sensor_xyyaw: Array, max_range_m: float) -> RangeScan:
    """The rays of a scan.

    Args:
        angles: directions ``(n,)`` in the sensor's frame (rad).
        ranges: along them ``(n,)`` (m); NaN, infinite, zero and negative ones say nothing, so that nothing is entered.
        sensor_xyyaw: pose ``(3,)`` of the sensor in the base frame.
        max_range_m: longer rays are cut there: they are free up to it, and unknown beyond.

    Raises:
        ValueError: shapes disagree, angles are not finite, or the largest range is not positive.
    """
    if angles.ndim != 1 or angles.shape != ranges.shape or sensor_xyyaw.shape != (3,):
        raise ValueError(
            f"angles, ranges, sensor_xyyaw have shapes {angles.shape}, {ranges.shape}, {sensor_xyyaw.shape}; expected "
            "(n,), (n,) and (3,)"
        )
    if not np.isfinite(angles).all() or not np.isfinite(sensor_xyyaw).all() or not max_range_m > 0.0:
        raise ValueError(
            f"angles or sensor_xyyaw are not finite, or max_range_m is {max_range_m}; expected finite numbers and a "
            "positive range"
        )
    known = np.isfinite(ranges) & (ranges > 0.0)
    lengths, directions = np.minimum(ranges[known], max_range_m), angles[known] + sensor_xyyaw[2]
    ends = sensor_xyyaw[:2] + lengths[:, None] * np.stack((np.cos(directions), np.sin(directions)), axis=-1)
    return RangeScan(sensor_xyyaw, ends.astype(np.float32), ranges[known] <= max_range_m)
