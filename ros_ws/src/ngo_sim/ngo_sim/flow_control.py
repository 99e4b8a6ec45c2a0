"""Keeps a simulator from running ahead of those who take its frames, and keeps its pace: without a clock or ROS."""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable


class FlowControl:
    """Counts the frames that each consumer still has in hand, from the stamps of what the consumers publish.

    A consumer is a topic. Its newest stamp says which frame it has finished, so frames that it skips are finished as
    well. A consumer of motion has nothing to say about its first frame: until its first answer, one frame is not
    counted. Consumers come and go while the simulator runs; a new one starts with nothing in hand.

    Raises ValueError where max_in_flight is below 1.
    """

    def __init__(self, max_in_flight: int) -> None:
        if max_in_flight < 1:
            raise ValueError(f"max_in_flight is {max_in_flight}; allowed: a whole number of at least 1")
        self._max_in_flight = max_in_flight
        self._stamps: deque[int] = deque()  # published and not finished by every consumer, rising
        self._last_published = -1
        self._finished: dict[str, int] = {}  # newest stamp finished, by topic
        self._answered: set[str] = set()

    @property
    def topics(self) -> frozenset[str]:
        """The topics that count now."""
        return frozenset(self._finished)

    def set_topics(self, topics: Iterable[str]) -> None:
        """Let these topics count from now on, and no others."""
        topics = set(topics)
        for topic in self._finished.keys() - topics:
            del self._finished[topic]
            self._answered.discard(topic)
        for topic in topics - self._finished.keys():
            self._finished[topic] = self._last_published
        self._forget_finished()

    def published(self, stamp_ns: int) -> None:
        """A frame with this stamp, newer than all before, was published."""
        if stamp_ns <= self._last_published:
            raise ValueError(f"stamp_ns is {stamp_ns}; expected one above {self._last_published}, the last frame's")
        self._last_published = stamp_ns
        self._stamps.append(stamp_ns)
        self._forget_finished()

    def seen(self, topic: str, stamp_ns: int) -> None:
        """A consumer published this stamp; one that no frame has reached yet is of another run, and ignored."""
        if topic in self._finished and self._finished[topic] < stamp_ns <= self._last_published:
            self._finished[topic] = stamp_ns
            self._answered.add(topic)
            self._forget_finished()

    def in_flight(self) -> int:
        """Frames that the slowest consumer has in hand."""
        stamps = list(self._stamps)
        counts = [
            len(stamps) - bisect_right(stamps, stamp) - (topic not in self._answered)
            for topic, stamp in self._finished.items()
        ]
        return max([0, *counts])

    def may_publish(self) -> bool:
        """Whether one more frame stays within max_in_flight."""
        return self.in_flight() < self._max_in_flight

    def waiting_for(self) -> list[str]:
        """The topics that have frames in hand."""
        newest = self._last_published
        return sorted(topic for topic, stamp in self._finished.items() if stamp < newest)

    def give_up(self) -> None:
        """Count every frame in hand as lost: go on as if all consumers had finished."""
        self._finished = dict.fromkeys(self._finished, self._last_published)
        self._forget_finished()

    def _forget_finished(self) -> None:
        oldest = min(self._finished.values(), default=self._last_published)
        while self._stamps and self._stamps[0] <= oldest:
            self._stamps.popleft()


class Pacer:
    """Says when the next frame of an even pace is due; one that is over a period late shifts those behind it."""

    def __init__(self) -> None:
        self._due_s: float | None = None

    def remaining_s(self, now_s: float) -> float:
        """Time until the next frame is due, at least 0; the first is due at once."""
        return 0.0 if self._due_s is None else max(0.0, self._due_s - now_s)

    def taken(self, now_s: float, rate: float) -> None:
        """A frame was taken now; the next is due 1 / rate after this one was due."""
        period_s = 1.0 / rate if rate > 0.0 else 0.0
        due_s = now_s if self._due_s is None else self._due_s
        self._due_s = max(due_s + period_s, now_s)


def header_stamp_ns(cdr: bytes) -> int:
    """The stamp in ns of a serialised message whose first field is a std_msgs/Header: no need to read the rest.

    Raises ValueError where the bytes are no CDR message of that length.
    """
    if len(cdr) < 12 or cdr[1] not in (0, 1):
        raise ValueError(
            f"cdr has {len(cdr)} bytes that begin with {bytes(cdr[:4])!r}; expected a CDR message with a header"
        )
    seconds, nanoseconds = struct.unpack_from("<iI" if cdr[1] == 1 else ">iI", cdr, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
