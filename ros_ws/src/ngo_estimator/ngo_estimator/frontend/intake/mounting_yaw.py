"""The yaw by which a scanner is mounted otherwise than it is said to be, from the way that wheels and scans measure.

A robot that drives straight ahead by its wheels drives straight ahead by its scans, unless the scanner looks to another
side than its mounting says, or its rays lie at other angles than its messages say. Of calibration that compares both
motions (Censi et al., "Simultaneous calibration of odometry and sensor parameters for mobile robots", 2013) this is the
one number that a robot shows without turning. Wheels need no calibration for it: an error of their radii and of their
distance changes ways and turns, and leaves the direction as it is.
"""

import math
from collections import deque

import numpy as np

from ngo_estimator.geometry.planar_motion import Array, compose, wrap

STRETCH_M = 0.5
_LONGEST_S = 5.0
_LARGEST_TURN_RAD = 0.3
_AGREE_RAD = 0.1
"""Turns of scans and wheels that differ by more: the wheels slipped."""

_KEPT = 512
FEWEST = 100
"""Stretches after which the yaw may be known."""

_SIGNIFICANCE = 5.0
_LEAST_RAD = 0.01
"""Deviations, and size, from which on the yaw is significant."""

_MEDIAN = 1.2533 * 1.4826
"""Deviation of a median of many, in median absolute deviations of each."""


class MountingYaw:
    """Running estimate of how much further to the left the scanner looks than its mounting says; bounded memory."""

    def __init__(self) -> None:
        self._found: deque[float] = deque(maxlen=_KEPT)
        self.interrupt()

    @property
    def yaw_rad(self) -> float:
        """The yaw (rad); 0 until it is significant."""
        if len(self._found) < FEWEST:
            return 0.0
        found = np.array(self._found)
        median = float(np.median(found))
        deviation = _MEDIAN * float(np.median(np.abs(found - median))) / math.sqrt(len(found))
        return median if abs(median) > max(_LEAST_RAD, _SIGNIFICANCE * deviation) else 0.0

    def interrupt(self) -> None:
        """What was driven since the last stretch does not count: scans or wheels are not sure of it."""
        self._scans, self._wheels, self._took_s = np.zeros(3), np.zeros(3), 0.0

    def observe(self, by_scans: Array, by_wheels: Array, elapsed_s: float) -> None:
        """Take the motion ``(3,)`` of the robot between two scans as both measure it."""
        self._scans, self._wheels = compose(self._scans, by_scans), compose(self._wheels, by_wheels)
        self._took_s += elapsed_s
        way = math.hypot(self._scans[0], self._scans[1])
        if way < STRETCH_M and self._took_s <= _LONGEST_S:
            return
        scans, wheels, took_s = self._scans, self._wheels, self._took_s
        self.interrupt()
        by_both = math.hypot(wheels[0], wheels[1])
        turned_apart = wrap(scans[2] - wheels[2])
        if (
            took_s > _LONGEST_S
            or min(scans[0], wheels[0]) <= 0.0
            or abs(scans[2]) > _LARGEST_TURN_RAD
            or abs(turned_apart) > _AGREE_RAD
            or not 0.5 * way < by_both < 2.0 * way
        ):
            return
        # A turn that is spread over the stretch turns its direction by half as much.
        apart = math.atan2(wheels[1], wheels[0]) - math.atan2(scans[1], scans[0])
        self._found.append(wrap(apart + 0.5 * turned_apart))
