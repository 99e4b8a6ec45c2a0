"""A correction that reaches the robot little by little instead of with a jump (no ROS here)."""

import math

import numpy as np

from ngo_estimator.data.state_arrays import Arrays, taken, taken_integer
from ngo_estimator.geometry.se2 import compose, inverse


class SmoothedCorrection:
    """Moves ``map_from_odom`` toward its newest value with a time constant.

    What moves smoothly is the robot's pose in ``map``: interpolating the transform itself would swing a robot far from
    the origin of ``odom`` through an arc. The gap to the newest value shrinks by 1 / e every ``time_constant_s`` of the
    stamps; 0 passes the newest value on.
    """

    def __init__(self, time_constant_s: float) -> None:
        if not 0.0 <= time_constant_s < math.inf:
            raise ValueError(f"time_constant_s is {time_constant_s}; expected 0 or more")
        self.time_constant_s = time_constant_s
        self.reset()

    def reset(self) -> None:
        """Forget the last value: the next one is taken as it is."""
        self._last: tuple[int, np.ndarray] | None = None

    def state(self) -> Arrays:
        """The last value, for ``restored``; nothing before the first one."""
        if self._last is None:
            return {}
        stamp_ns, map_from_odom = self._last
        return {"stamp_ns": np.array(stamp_ns, np.int64), "map_from_odom_xyyaw": map_from_odom.copy()}

    def restored(self, arrays: Arrays) -> "SmoothedCorrection":
        """Another one with this time constant, and the last value of a ``state()``; raises ``StateError``."""
        other = SmoothedCorrection(self.time_constant_s)
        if arrays:
            last = taken(arrays, "map_from_odom_xyyaw", np.float64, 3)
            other._last = taken_integer(arrays, "stamp_ns", -(2**63)), last
        return other

    def update(self, stamp_ns: int, map_from_odom_xyyaw: np.ndarray, odom_from_base_xyyaw: np.ndarray) -> np.ndarray:
        """The smoothed ``map_from_odom`` ``(3,)`` at a stamp, with the robot's pose in odom."""
        smoothed = map_from_odom_xyyaw
        if self._last is not None and self.time_constant_s > 0.0:
            last_ns, last = self._last
            share = -math.expm1(-max(0, stamp_ns - last_ns) * 1e-9 / self.time_constant_s)
            smoothed = _moved(last, map_from_odom_xyyaw, odom_from_base_xyyaw, share)
        self._last = stamp_ns, smoothed
        return smoothed


def _moved(from_xyyaw: np.ndarray, to_xyyaw: np.ndarray, base_xyyaw: np.ndarray, share: float) -> np.ndarray:
    """The transform that puts ``base`` at this share of the way from where one puts it to where the other does."""
    start, end = compose(from_xyyaw, base_xyyaw), compose(to_xyyaw, base_xyyaw)
    way = end - start
    way[2] = math.remainder(way[2], math.tau)
    return compose(start + share * way, inverse(base_xyyaw))
