"""The scans of one scanner where two publish on one topic in one frame: each is like the one before the last.

Nothing says where the other one sits, so its scans are of no use.
"""

from collections import deque

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


class SingleScanner:
    """Tells the scans of the scanner that was heard first from those of the other."""

    def __init__(self) -> None:
        self.left_out = 0
        """How many scans are of another scanner."""
        self._last: deque[tuple[Ranges, bool]] = deque(maxlen=2)  # whether it is of the first scanner
        self._alternates: deque[bool] = deque(maxlen=_SCANS)
        self._begin = np.inf

    def interrupt(self) -> None:
        """What comes is not compared with what came; the next scan is of the scanner that counts."""
        self._last.clear()

    def counts(self, scan: LidarScan) -> bool:
        """Whether a scan is of the scanner that counts."""
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

    def remark(self) -> str:
        """In words; nothing where there is one scanner."""
        return (
            f"{self.left_out} of its scans are of another scanner in the same frame: left out" if self.left_out else ""
        )


def _apart(one: Ranges, other: Ranges) -> float:
    """How far the ranges of two scans are apart in the median (m); infinite where they have too little in common."""
    if len(one) != len(other):
        return np.inf
    seen = np.isfinite(other)
    both = np.isfinite(one) & seen
    return float(np.median(np.abs(one[both] - other[both]))) if both.sum() > _COMMON * seen.sum() else np.inf
