"""The yaw by which a scanner is mounted otherwise than it is said to be, from the way that wheels and scans measure.

A robot that drives straight ahead by its wheels drives straight ahead by its scans, unless the scanner looks to another
side than its mounting says, or its rays lie at other angles than its messages say. Of calibration that compares both
motions (Censi et al., "Simultaneous calibration of odometry and sensor parameters for mobile robots", 2013) this is the
one number that a robot shows without turning. Wheels need no calibration for it: an error of their radii and of their
distance changes ways and turns, and leaves the direction as it is.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry.planar_motion import Array, between, wrap

_MEDIAN = 1.2533 * 1.4826
"""Deviation of a median of many, in median absolute deviations of each."""


@dataclass(frozen=True)
class MountingYawConfig:
    """How the yaw is estimated: from stretches of ``stretch_m`` forward, driven in ``longest_s`` at most, with turns up
    to ``largest_turn_rad``. Scans and wheels agree about the turn to ``agree_rad`` and about the way to a factor
    of two, or the wheels slipped. The latest ``kept`` stretches count. After ``fewest`` of them their median is
    significant from ``significance`` of its deviations and ``least_rad`` on."""

    stretch_m: float = 0.5
    longest_s: float = 5.0
    largest_turn_rad: float = 0.3
    agree_rad: float = 0.1
    kept: int = 512
    fewest: int = 100
    significance: float = 5.0
    least_rad: float = 0.01

    def __post_init__(self) -> None:
        positive = (
            self.stretch_m, self.longest_s, self.largest_turn_rad, self.agree_rad, self.significance, self.least_rad
        )  # fmt: skip
        if not all(0.0 < value < math.inf for value in positive) or not 1 <= self.fewest <= self.kept:
            raise ValueError(
                "stretch_m, longest_s, largest_turn_rad, agree_rad, significance, least_rad are "
                f"{positive} and fewest, kept are {self.fewest}, {self.kept}; expected positive numbers, and 1 <= "
                "fewest <= kept"
            )


class MountingYaw:
    """Running estimate of how much further to the left the scanner looks than its mounting says; bounded memory."""

    def __init__(self, config: MountingYawConfig | None = None) -> None:
        self.config = config or MountingYawConfig()
        self._found: deque[float] = deque(maxlen=self.config.kept)
        self._start: tuple[float, Array, Array] | None = None

    @property
    def yaw_rad(self) -> float:
        """The yaw (rad); 0 until it is significant."""
        if len(self._found) < self.config.fewest:
            return 0.0
        found = np.array(self._found)
        median = float(np.median(found))
        deviation = _MEDIAN * float(np.median(np.abs(found - median))) / math.sqrt(len(found))
        return median if abs(median) > max(self.config.least_rad, self.config.significance * deviation) else 0.0

    def observe(self, stamp_s: float, by_scans: Array, by_wheels: Array) -> None:
        """Take the robot's pose ``(3,)`` at one time (s), in a frame of the scans and in one of the wheels."""
        if self._start is None or stamp_s <= self._start[0]:
            self._start = stamp_s, by_scans, by_wheels
            return
        start_s, scans_start, wheels_start = self._start
        scans = between(scans_start, by_scans)
        way = math.hypot(scans[0], scans[1])
        if way < self.config.stretch_m and stamp_s - start_s <= self.config.longest_s:
            return
        self._start = stamp_s, by_scans, by_wheels
        wheels = between(wheels_start, by_wheels)
        by_both = math.hypot(wheels[0], wheels[1])
        turned_apart = wrap(scans[2] - wheels[2])
        if (
            stamp_s - start_s > self.config.longest_s
            or min(scans[0], wheels[0]) <= 0.0
            or abs(scans[2]) > self.config.largest_turn_rad
            or abs(turned_apart) > self.config.agree_rad
            or not 0.5 * way < by_both < 2.0 * way
        ):
            return
        # A turn that is spread over the stretch turns its direction by half as much.
        apart = math.atan2(wheels[1], wheels[0]) - math.atan2(scans[1], scans[0])
        self._found.append(wrap(apart + 0.5 * turned_apart))

    def interrupt(self) -> None:
        """What was driven since the last pose does not count: scans or wheels are not sure of it."""
        self._start = None
