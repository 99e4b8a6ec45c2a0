"""The scans of one scanner, each once.

Where two publish on one topic in one frame, each scan is like the one before the last; nothing says where the other one
sits, so its scans are of no use. A scan that is published again has the same ranges too soon: a simulated scanner
without noise sees the same while its robot stands, but at its usual pace. One that froze has them while the wheels
drive.
"""

import math
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ngo_recordings.scan_stream import LidarScan

Ranges = NDArray[np.float32]

_DIRECTIONS = 90
_TURNS = range(-5, 6)
"""Directions by which a robot may turn from scan to scan: one that sways comes back to the one before the last, too."""

_COMMON = 0.5
"""Share of a scan's rays that another one must have, too: otherwise they may be halves of one turn."""

_ALIKE = 0.5
"""Two scans are alike where they differ by less than this share of what another one differs."""

_LEAST_M = 0.1
"""Scans that differ by less are of one scanner."""

_SCANS = 20
_SHARE = 0.8
"""Of so many scans, this share must be like the one before the last."""

_SOON = 0.75
"""Share of the usual time to other ranges within which the same ones were not measured anew."""

_LONGEST_NS = 1_000_000_000
"""Scanners need less for a scan: a robot stood where the same ranges came for longer."""

_PERIODS = 10

_DROVE, _DROVE_NS = 0.3, 5_000_000_000
"""Way or turn (m, rad) by the wheels in so long, over which no scanner sees the same."""

_DISTINCT = 10
"""Ranges without which it may: it sees nothing."""

MotionSince = Callable[[int], NDArray[np.float64] | None]
"""The motion ``(3,)`` by the wheels from a stamp on; None where it is not known."""


class SingleScanner:
    """Tells the scans of the scanner that was heard first from those of the other, and from those that repeat one."""

    def __init__(self) -> None:
        self.left_out = self.repeated = 0
        """How many scans are of another scanner, and how many repeat the one before."""
        self._frozen = False
        self._ranges: Ranges | None = None
        self._first_ns = 0  # when the last ranges came first
        self._periods_ns: deque[int] = deque(maxlen=_PERIODS)
        self._last: deque[tuple[Ranges, bool]] = deque(maxlen=2)  # whether it is of the first scanner
        self._alternates: deque[bool] = deque(maxlen=_SCANS)
        self._begin = np.inf

    def interrupt(self) -> None:
        """What comes is not compared with what came; the next scan is of the scanner that counts."""
        self._last.clear()

    def counts(self, scan: LidarScan, driven: MotionSince) -> bool:
        """Whether a scan is of the scanner that counts, and does not repeat the last one."""
        return not self._repeats(scan, driven) and self._is_ours(scan)

    def _repeats(self, scan: LidarScan, driven: MotionSince) -> bool:
        late_ns = scan.stamp_ns - self._first_ns
        if self._ranges is None or not np.array_equal(scan.ranges, self._ranges, equal_nan=True):
            if self._ranges is not None and 0 < late_ns < _LONGEST_NS:
                self._periods_ns.append(late_ns)
            self._ranges, self._first_ns, self._frozen = scan.ranges, scan.stamp_ns, False
            return False
        if not self._frozen and (moved := driven(max(self._first_ns, scan.stamp_ns - _DROVE_NS))) is not None:
            drove = max(math.hypot(moved[0], moved[1]), abs(moved[2])) > _DROVE
            self._frozen = drove and len(np.unique(scan.ranges[np.isfinite(scan.ranges)])) > _DISTINCT
        repeats = self._frozen or 0 < late_ns < _SOON * min(self._periods_ns, default=0)
        self.repeated += repeats
        return repeats

    def _is_ours(self, scan: LidarScan) -> bool:
        begin, self._begin = self._begin, scan.angle_min
        if abs(begin - scan.angle_min) > 2.0 * abs(scan.angle_increment):  # sectors look at different things
            self._last.clear()
            self._alternates.clear()
        ranges = scan.ranges
        seen = ranges[np.arange(_DIRECTIONS) * len(ranges) // _DIRECTIONS] if len(ranges) else ranges
        ours = self._is_first(seen)
        self._last.append((seen, ours))
        counts = ours or sum(self._alternates) < _SHARE * _SCANS
        self.left_out += not counts
        return counts

    def _is_first(self, seen: Ranges) -> bool:
        if not self._last:
            return True
        last, second = self._last[-1]
        near = _apart(seen, last)
        if len(self._last) == 2:
            before, first = self._last[0]
            far = _apart(seen, before)
            if far < _ALIKE * near < np.inf:
                near = min(_apart(np.roll(seen, turn), last) for turn in _TURNS)
            alternates = _LEAST_M < near < np.inf and far < _ALIKE * near
            self._alternates.append(alternates)
            if alternates and first == second:  # both were taken for one
                self._last[-1] = last, False
                return True
            if alternates or near < _ALIKE * far:
                return first if alternates else second
        return not second if _LEAST_M < near < np.inf else second

    def remarks(self) -> list[str]:
        """In words, a line each; none where each scan is a new one of one scanner."""
        told = {
            "are the one before once more, at once or while the wheels drive": self.repeated,
            "are of another scanner in the same frame": self.left_out,
        }
        return [f"{count} of its scans {what}: left out" for what, count in told.items() if count]


def _apart(one: Ranges, other: Ranges) -> float:
    """How far the ranges of two scans are apart in the median (m); infinite where they have too little in common."""
    if len(one) != len(other):
        return np.inf
    seen = np.isfinite(other)
    both = np.isfinite(one) & seen
    return float(np.median(np.abs(one[both] - other[both]))) if both.sum() > _COMMON * seen.sum() else np.inf
