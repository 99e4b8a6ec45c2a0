"""The stamps of a CARMEN log: which of them tell the time, and what is made where none do."""

from __future__ import annotations

import numpy as np

MADE_PERIOD_S = 1.0
"""Time between two scans of a log without usable stamps: slow enough for any robot, and said wherever it is used."""

_RISING_SHARE = 0.9
_STRAY_NS = 1_000_000_000


def choose_stamps(is_scan: np.ndarray, stamps: np.ndarray) -> tuple[np.ndarray, bool, tuple[str, ...]]:
    """Stamps by line (ns), whether they were made, and a note where they are not the usual ones."""
    for column, note in ((0, ()), (1, ("the stamps are the logger's, for the scans' own ones are of no use",))):
        candidate = stamps[:, column]
        if _rises(candidate[is_scan] if is_scan.any() else candidate):
            # A line without a stamp has that of the line before it.
            known = np.maximum.accumulate(np.where(np.isfinite(candidate), np.arange(len(candidate)), 0))
            known[: np.flatnonzero(np.isfinite(candidate))[0]] = np.flatnonzero(np.isfinite(candidate))[0]
            return np.round(candidate[known] * 1e9).astype(np.int64), False, note
    made = _made_stamps(is_scan)
    note = (
        f"the log has no usable stamps: made from the order of its lines, {MADE_PERIOD_S:g} s from scan to scan; "
        "speeds and time differences mean nothing",
    )
    return np.round(made * 1e9).astype(np.int64), True, note


def stray_lines(is_scan: np.ndarray, stamps_ns: np.ndarray) -> np.ndarray:
    """Lines between two scans whose stamps are more than a second from the time between those."""
    if not is_scan.any():
        return np.zeros(len(is_scan), bool)
    scans = stamps_ns[is_scan]
    after = np.cumsum(is_scan)  # scans up to each line
    before_ns = np.concatenate(([min(0, scans[0])], scans))[after]
    next_ns = np.concatenate((scans, [np.iinfo(np.int64).max // 2]))[np.minimum(after, len(scans))]
    low, high = np.minimum(before_ns, next_ns), np.maximum(before_ns, next_ns)
    return np.asarray(~is_scan & ((stamps_ns < low - _STRAY_NS) | (stamps_ns > high + _STRAY_NS)))


def _rises(stamps: np.ndarray) -> bool:
    """Whether stamps tell the time: nearly each is later than the one before."""
    if len(stamps) < 2:
        return bool(len(stamps) and stamps[0] > 0.0)
    with np.errstate(invalid="ignore"):
        return bool(np.mean(np.diff(stamps) > 0.0) >= _RISING_SHARE)


def _made_stamps(is_scan: np.ndarray) -> np.ndarray:
    """Scans one period apart, the lines between two of them evenly in between, s."""
    if not is_scan.any():
        return (np.arange(len(is_scan)) + 1.0) * MADE_PERIOD_S
    before = np.concatenate(([0], np.cumsum(is_scan)[:-1]))  # scans before each line
    scans = np.concatenate(([-1], np.flatnonzero(is_scan), [len(is_scan)]))
    start, end = scans[before], scans[before + 1]
    return np.asarray((before + (np.arange(len(is_scan)) - start) / (end - start)) * MADE_PERIOD_S)
