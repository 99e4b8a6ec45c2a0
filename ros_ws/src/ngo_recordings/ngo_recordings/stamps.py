"""Stamps of a topic that run as no clock does: they stand still, or are in another unit, or overflowed."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import Any

import numpy as np

_LOOK, _STRIDE = 60, 10
"""Messages that are looked at, and how far apart those are that are compared: several may carry one stamp."""

_PACE = 50.0
"""A simulation, and a recording that is played, run up to so many times faster or slower than the recorder's clock."""


def stamp_fault(messages: Iterable[Any]) -> str:
    """What is wrong with the stamps of a topic by the times at which its messages were recorded, in words; nothing
    where they are right, or nothing tells it."""
    times = []
    for message in islice(messages, _LOOK):
        if (header := getattr(message.value, "header", None)) is None:
            return ""
        times.append((int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec), message.log_time_ns))
    apart = np.array(times[_STRIDE:], np.float64) - np.array(times[:-_STRIDE], np.float64)
    if not len(apart):
        return ""
    stamped, recorded = np.median(apart, axis=0).tolist()
    if recorded <= 0.0 or recorded / _PACE < stamped < recorded * _PACE:
        return ""
    return f"run {stamped / recorded:.3g} times as fast as the clock" if stamped else "stand still"


def stamp_as_recorded(message: Any) -> None:
    """Give a message the stamp at which it was recorded."""
    stamp = message.value.header.stamp
    stamp.sec, stamp.nanosec = divmod(message.log_time_ns, 10**9)
