"""How fast a robot's velocity changes, learned from the motions that walls tell.

Not in the paper. Robots differ: one takes seconds to reach 0.5 m/s, another reaches 3 m/s in one. Where a corridor
hides the motion, what such a robot may have done meanwhile is learned from where walls showed it.
"""

import math

import numpy as np

from ngo_estimator.geometry.planar_motion import Array

_SPAN_S = 0.4
"""Velocities are means over at least so long: shorter ones are noise."""

_FIRST_RATE_M_S = 0.1
"""Deviation of the velocity's change in one second, before it was measured; it counts as some spans."""

_FIRST_SPANS = 5

_MEMORY = 100
"""Spans, over which means are taken."""

_LARGEST_CHANGE = 4.0
"""Deviations, to which a change is cut: a wrong registration is no acceleration."""


class UsualMotion:
    """Means over the last measured velocities.

    ``least_m_s`` is the least deviation of a velocity that nothing tells.
    """

    def __init__(self, least_m_s: float) -> None:
        self._least = least_m_s
        self._changes = _FIRST_RATE_M_S**2  # squared change of the velocity a second
        self._mean, self._square = np.zeros(2), 0.0
        self._spans = 0
        self._way, self._elapsed = np.zeros(2), 0.0
        self._last: tuple[Array, float] | None = None

    @property
    def rate_m_s(self) -> float:
        """Deviation (m/s) of the velocity's change in one second."""
        return math.sqrt(self._changes)

    @property
    def largest_m_s(self) -> float:
        """Deviation (m/s) of a velocity that nothing has told for long: that of the difference of two velocities."""
        return max(self._least, math.sqrt(2.0 * max(self._square - float(self._mean @ self._mean), 0.0)))

    def observe(self, step: Array, elapsed: float) -> None:
        """A step ``(3,)`` that walls told, ``elapsed`` seconds long."""
        self._way, self._elapsed = self._way + step[:2], self._elapsed + elapsed
        if self._elapsed < _SPAN_S:
            return
        velocity, span_s = self._way / self._elapsed, self._elapsed
        self._way, self._elapsed = np.zeros(2), 0.0
        if self._last is not None:
            change = velocity - self._last[0]
            # Means over two neighbouring spans of a velocity that wanders differ by two thirds of its change.
            rate = 3.0 * float(change @ change) / (span_s + self._last[1])
            self._spans = min(self._spans + 1, _MEMORY)
            weight = 1.0 / (self._spans + _FIRST_SPANS)
            self._changes += weight * (min(rate, _LARGEST_CHANGE**2 * self.rate_m_s**2) - self._changes)
            self._mean = self._mean + (velocity - self._mean) / self._spans
            self._square += (float(velocity @ velocity) - self._square) / self._spans
        self._last = velocity, span_s

    def interrupt(self) -> None:
        """The walls do not tell the newest step."""
        self._way, self._elapsed, self._last = np.zeros(2), 0.0, None
