"""Stamps of readings that came in bunches, spread evenly.

Drivers that stamp what they receive give several readings nearly the same stamp after a pause. The sensor measured them
at its usual pace. Only bunches are touched: a reading that is missing leaves its gap.
"""

from collections import deque

_BUNCHED = 12.0
"""Readings closer than the usual period divided by this came in a bunch."""

_KEPT = 64
"""Gaps that make the usual period."""

_LONGEST_S = 2.0
"""A longer gap counts as this: the sensor paused."""


class UsualPeriod:
    """The running mean of the gaps between stamps (s), which bunches do not change."""

    def __init__(self) -> None:
        self._gaps: deque[float] = deque(maxlen=_KEPT)
        self._sum = 0.0

    def add(self, gap_s: float) -> None:
        """Take a gap (s)."""
        if len(self._gaps) == _KEPT:
            self._sum -= self._gaps[0]
        self._gaps.append(min(gap_s, _LONGEST_S))
        self._sum += self._gaps[-1]

    @property
    def period_s(self) -> float:
        """The usual period; 0 before a gap is known."""
        return self._sum / len(self._gaps) if self._gaps else 0.0

    def bunched(self, gap_s: float) -> bool:
        """Whether a reading came in a bunch with the one before."""
        return gap_s < self.period_s / _BUNCHED

    def late(self, gap_s: float) -> bool:
        """Whether a reading may be the first of a bunch."""
        return gap_s > 1.5 * self.period_s
