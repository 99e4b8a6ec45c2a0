"""Single stamps far from those before and after: a clock that was not set yet, a damaged message.

A source that restarts goes on from where its stamps jumped to; after a stray stamp the old ones go on. So a record
whose stamp jumps waits for the next one, which tells both apart.
"""

from typing import Generic, TypeVar

from ngo_estimator.data.relative_step import RESTART_AFTER_NS
from ngo_recordings.scan_stream import LidarScan, WheelPose

_FAR_NS = 60_000_000_000
"""A stamp that is so much later than the one before jumps; sensors are not so slow, but recorders pause."""


Record = TypeVar("Record", LidarScan, WheelPose)


class StrayStamps(Generic[Record]):
    """Hands on the records of one source, those with a stray stamp left out."""

    def __init__(self) -> None:
        self.left_out = 0
        """How many had a stray stamp."""
        self._held: Record | None = None
        self._last_ns: int | None = None

    def add(self, record: Record) -> list[Record]:
        """Take a record; returns those that are to be used by now."""
        held, self._held = self._held, None
        if self._last_ns is not None and _goes_on(self._last_ns, record.stamp_ns):
            self.left_out += held is not None
            found = [record]
        elif held is not None and _goes_on(held.stamp_ns, record.stamp_ns):
            found = [held, record]
        else:
            self.left_out += held is not None
            self._held = record
            return []
        self._last_ns = record.stamp_ns
        return found

    def flush(self) -> list[Record]:
        """The record that waits, if it is the only one: nothing more comes, and one that jumps begins nothing."""
        held, self._held = self._held, None
        if held is not None and self._last_ns is not None:
            self.left_out += 1
            return []
        return [] if held is None else [held]


def _goes_on(before_ns: int, stamp_ns: int) -> bool:
    return before_ns - RESTART_AFTER_NS < stamp_ns < before_ns + _FAR_NS
