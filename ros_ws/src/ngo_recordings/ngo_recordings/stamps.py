"""Stamps of a topic that run as no clock does: they stand still, or are in another unit, or overflowed."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import Any

import numpy as np

_APART_NS, _MOST = 1_000_000_000, 5000
"""Log time between messages that are compared, for many are recorded at once, and how many are looked at."""

_PACE = 300.0
"""A simulation, and a recording that is played, run up to so many times faster or slower than the recorder's clock."""


def stamp_fault(messages: Iterable[Any]) -> str:
    """What is wrong with the stamps of a topic by the times at which its messages were recorded, in words; nothing
    where they are right, or nothing tells it."""
    times: list[tuple[int, int]] = []
    for message in islice(messages, _MOST):
        if (header := getattr(message.value, "header", None)) is None:
            return ""
        times.append((int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec), message.log_time_ns))
        if message.log_time_ns - times[0][1] >= 2 * _APART_NS:
            break
    stamped, recorded = np.array(times, np.int64).reshape(-1, 2).T
    later = np.searchsorted(recorded, recorded + _APART_NS)
    earlier = np.flatnonzero(later < len(times))
    if not len(earlier):
        return ""
    later = later[earlier]
    pace = float(np.median((stamped[later] - stamped[earlier]) / (recorded[later] - recorded[earlier])))
    if 1.0 / _PACE < pace < _PACE:
        return ""
    return f"run {pace:.3g} times as fast as the clock" if pace else "stand still"


def stamp_as_recorded(message: Any) -> None:
    """Give a message the stamp at which it was recorded."""
    stamp = message.value.header.stamp
    stamp.sec, stamp.nanosec = divmod(message.log_time_ns, 10**9)
