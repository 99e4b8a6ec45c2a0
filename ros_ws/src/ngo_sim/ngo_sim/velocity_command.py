"""A velocity that comes from outside, and how a robot of limited speed and acceleration follows it. No ROS."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ngo_sim.convex_shapes import Floats


@dataclass(frozen=True)
class VelocityLimits:
    """What a robot can do, forward and backward: m/s, rad/s, m/s^2 and rad/s^2."""

    speed_mps: float
    turn_rate_rps: float
    acceleration_mps2: float
    turn_acceleration_rps2: float


class VelocityCommand:
    """The newest command, which holds for timeout_s of simulated time; after that the robot is to stand."""

    def __init__(self, limits: VelocityLimits, timeout_s: float) -> None:
        self.limits, self._timeout_s = limits, timeout_s
        self._wanted = (0.0, 0.0)
        self._left_s = 0.0

    def set(self, speed_mps: float, turn_rate_rps: float) -> None:
        """Somebody sent a command; ValueError where a number is not finite."""
        if not (math.isfinite(speed_mps) and math.isfinite(turn_rate_rps)):
            raise ValueError(f"speed and turn rate are {speed_mps} and {turn_rate_rps}; expected finite numbers")
        self._wanted, self._left_s = (speed_mps, turn_rate_rps), self._timeout_s

    def next_twist(self, twist: Floats, period_s: float) -> Floats:
        """(2,) speed and turn rate of the next period after twist (2,); that period counts as gone then."""
        speed, turn_rate = self._wanted if self._left_s > 0.0 else (0.0, 0.0)
        self._left_s -= period_s
        limits = self.limits
        return np.array(
            (
                _towards(speed, twist[0], limits.speed_mps, limits.acceleration_mps2 * period_s),
                _towards(turn_rate, twist[1], limits.turn_rate_rps, limits.turn_acceleration_rps2 * period_s),
            )
        )


def _towards(wanted: float, now: float, most: float, change: float) -> float:
    wanted = min(max(wanted, -most), most)
    return float(min(max(wanted, now - change), now + change))
