"""When something that costs time may be published again (no ROS here)."""

import math

LARGEST_SHARE = 0.1
"""Of all time at most so much is spent on publishing: what takes long comes more seldom than its rate says."""


class PublicationPace:
    """Allows publications at ``rate_hz`` and in ``LARGEST_SHARE`` of all time at most; at a rate of 0, always.

    Of ``equals`` publishers each has an equal part of that share.
    """

    def __init__(self, rate_hz: float, equals: int = 1) -> None:
        if not 0.0 <= rate_hz < math.inf:
            raise ValueError(f"rate_hz is {rate_hz}; expected 0 or more")
        self._period_s = 1.0 / rate_hz if rate_hz > 0.0 else 0.0
        self._share = LARGEST_SHARE / equals
        self._next_s = -math.inf

    def is_due(self, now_s: float) -> bool:
        """Whether it is time."""
        return now_s >= self._next_s

    def published(self, started_s: float, ended_s: float) -> None:
        """A publication took from ``started_s`` to ``ended_s``."""
        if self._period_s > 0.0:
            self._next_s = max(started_s + self._period_s, started_s + (ended_s - started_s) / self._share)
