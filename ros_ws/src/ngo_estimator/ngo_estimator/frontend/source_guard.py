"""Holds on to one publisher of a topic when several publish on it (no ROS here)."""

from collections.abc import Hashable

FURTHEST_AHEAD = 1000
"""Messages that may be lost in a row before the next one counts as another publisher's."""


class SourceGuard:
    """Tells the messages of the publisher that was heard first from those of others on the same topic.

    A message says of itself what its ``identity`` is, and the middleware its number in its publisher's own count. What
    has the same identity and comes next in the count is of the same publisher. Others are refused until the held one
    has been silent for ``timeout_s``. As long as there is one publisher alone, everything is admitted: a change of
    identity is its restart.
    """

    def __init__(self, timeout_s: float) -> None:
        if not timeout_s > 0.0:
            raise ValueError(f"timeout_s is {timeout_s}; expected more than 0")
        self.timeout_s = timeout_s
        self.reset()

    def reset(self) -> None:
        """Hold on to nobody: the next message is admitted."""
        self._identity: Hashable = None
        self._sequence: int | None = None
        self._heard_ns: int | None = None

    def admits(self, publishers: int, identity: Hashable, sequence: int | None, received_ns: int) -> bool:
        """Whether a message is of the held publisher, which it becomes where there was none.

        Args:
            publishers: how many there are on the topic now.
            identity: what a message says of its source.
            sequence: number of the message in its publisher's count; None where the middleware has none.
            received_ns: when it arrived, on any one clock.
        """
        alive = self._heard_ns is not None and received_ns - self._heard_ns < self.timeout_s * 1e9
        if publishers > 1 and alive and not self._continues(identity, sequence):
            return False
        self._identity, self._sequence, self._heard_ns = identity, sequence, received_ns
        return True

    def _continues(self, identity: Hashable, sequence: int | None) -> bool:
        if identity != self._identity:
            return False
        if sequence is None or self._sequence is None:
            return True
        return 0 < sequence - self._sequence <= FURTHEST_AHEAD
