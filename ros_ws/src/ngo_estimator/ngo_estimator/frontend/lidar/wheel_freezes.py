"""Times in which the wheels stop counting while the robot moves on.

Not in the paper. Some robots repeat the last pose of their wheels for up to a second or two, and then go on where the
robot is. A robot that brakes slows down before it stands; wheels that freeze stand from one reading to the next. Once
they count again, their way since they froze is right as a whole.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ngo_estimator.geometry.planar_motion import Array

_KEPT = 16
"""Freezes that are remembered: scans are seconds late at most."""


@dataclass(frozen=True)
class WheelFreezesConfig:
    """Wheels froze where the robot would have had to brake harder than ``acceleration_m_s2`` or ``acceleration_rad_s2``
    over its last ``braking_s``, in which every reading moved. After ``longest_s`` they count again, as they are."""

    acceleration_m_s2: float = 2.0
    acceleration_rad_s2: float = 4.0
    braking_s: float = 0.3
    longest_s: float = 2.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} is {value}; expected a positive number")


class WheelFreezes:
    """Takes the times of readings that stand and that move, and tells the freezes among them."""

    def __init__(self, config: WheelFreezesConfig) -> None:
        self.config = config
        self._stopped_s: float | None = None  # the last reading that moved, of wheels that stand
        self._froze = False
        self._stood_s = -math.inf  # the newest reading that stood
        self._ended: deque[tuple[float, float]] = deque(maxlen=_KEPT)

    def moved(self, last_s: float, stamp_s: float) -> None:
        """The reading of ``stamp_s`` is another than that of ``last_s``, the one before it."""
        if self._froze and self._stopped_s is not None and last_s - self._stopped_s <= self.config.longest_s:
            self._ended.append((self._stopped_s, stamp_s))
        self._stopped_s, self._froze = None, False

    def stood(self, last_s: float, stamp_s: float, moved_before: Callable[[float], tuple[Array, float]]) -> None:
        """The reading of ``stamp_s`` is that of ``last_s`` again.

        ``moved_before`` gives what the wheels counted ``(3,)`` before a time, and in how many seconds: ``braking_s`` or
        a little more.
        """
        if self._stopped_s is None:
            motion, elapsed_s = moved_before(last_s)
            # The way of a robot that brakes until it stands.
            way_m = 0.5 * self.config.acceleration_m_s2 * elapsed_s**2
            turn_rad = 0.5 * self.config.acceleration_rad_s2 * elapsed_s**2
            farther = math.hypot(motion[0], motion[1]) > way_m or abs(motion[2]) > turn_rad
            # Drivers that repeat each pose, and jumps of wheels that stand, have readings that stood just before.
            self._froze = farther and min(elapsed_s, last_s - self._stood_s) > 0.99 * self.config.braking_s
            self._stopped_s = last_s
        self._stood_s = stamp_s

    @property
    def lasts(self) -> bool:
        """The wheels froze and stand still, however long ago."""
        return self._froze

    def since(self, at_s: float) -> float | None:
        """When the wheels froze that did not count at a time; None where they counted, or the robot stood."""
        if self._froze and self._stopped_s is not None and at_s > self._stopped_s:
            return self._stopped_s if self._stood_s - self._stopped_s <= self.config.longest_s else None
        return next((start for start, end in reversed(self._ended) if start < at_s < end), None)
