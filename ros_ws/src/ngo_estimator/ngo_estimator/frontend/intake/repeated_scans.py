"""Scans that are published again, with another stamp or on another topic: the robot did not stand in between.

A simulated scanner without noise sees the same while its robot stands, too, but then at its usual pace.
"""

from collections import deque

import numpy as np

from ngo_recordings.scan_stream import LidarScan

_SOON = 0.75
"""Share of the usual time to other ranges within which the same ones were not measured anew."""

_LONGEST_NS = 1_000_000_000
"""Scanners need less for a scan: a robot stood where the same ranges came for longer."""

_KEPT = 10


class RepeatedScans:
    """Tells the scans of one scanner that only repeat the last one."""

    def __init__(self) -> None:
        self.count = 0
        """How many did."""
        self._ranges: np.ndarray | None = None
        self._first_ns = 0  # when the last ranges came first
        self._periods_ns: deque[int] = deque(maxlen=_KEPT)

    def repeats(self, scan: LidarScan) -> bool:
        """Whether a scan is the last one again."""
        late_ns = scan.stamp_ns - self._first_ns
        same = self._ranges is not None and np.array_equal(scan.ranges, self._ranges, equal_nan=True)
        if not same:
            if self._ranges is not None and 0 < late_ns < _LONGEST_NS:
                self._periods_ns.append(late_ns)
            self._ranges, self._first_ns = scan.ranges, scan.stamp_ns
            return False
        repeated = bool(self._periods_ns) and 0 < late_ns < _SOON * min(self._periods_ns)
        self.count += repeated
        return repeated

    def remark(self) -> str:
        """In words; nothing where there were none."""
        return f"{self.count} of its scans are the one before once more: left out" if self.count else ""
