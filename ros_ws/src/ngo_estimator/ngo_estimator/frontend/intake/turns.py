"""Scans that belong together, as one: the sectors of a turn, and what several scanners see at once.

What belongs together shows by itself: parts come round again. A part that looks where one looked before, from the same
scanner, begins the next turn; a turn is whole as soon as all parts of the last one are in it. So one scanner whose
scans are whole costs nothing, and a scanner that fails is missed once.
"""

import math
from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry.planar_motion import Array, between
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan

_LONGEST_NS = 1_000_000_000
"""From the first part of a turn to its last."""

_OVERLAP = 0.5
"""Share of the smaller of two fields of view: parts that share more look at the same."""

_PAUSE = 2.0
"""A pause within a turn that is so much longer than the one before it ends the turn."""

_MOST_RAYS = 4096
_ROUNDED = 0.01
"""Rays by which an increment, a short number, may miss a whole turn."""


@dataclass(frozen=True, eq=False)
class Part:
    """A scan of one scanner, which sits there."""

    scan: LidarScan
    mounting: Mounting
    scanner: str

    @property
    def begin(self) -> float:
        """The least angle of its rays (rad)."""
        return min(self.scan.angle_min, self.scan.angle_min + self.width * math.copysign(1.0, self._increment))

    @property
    def width(self) -> float:
        """How far its rays spread (rad)."""
        return abs(self._increment) * max(len(self.scan.ranges) - 1, 1)

    @property
    def _increment(self) -> float:
        return self.scan.angle_increment

    def repeats(self, other: "Part") -> bool:
        """Whether it looks where another part of the same scanner looked."""
        if self.scanner != other.scanner:
            return False
        ours, its = self.scan, other.scan
        if (ours.angle_min, ours.angle_increment) == (its.angle_min, its.angle_increment):
            return True
        shared = 0.0
        for turn in (-math.tau, 0.0, math.tau):
            low = max(self.begin, other.begin + turn)
            high = min(self.begin + self.width, other.begin + other.width + turn)
            shared += max(high - low, 0.0)
        return shared > _OVERLAP * min(self.width, other.width)


class Turns:
    """Puts parts together to turns, one after the other."""

    def __init__(self) -> None:
        self._held: list[Part] = []
        self._last: list[Part] = []
        self._first: Part | None = None
        self._end_ns = self._between_ns = 0  # the newest part, and the time from the last turn to this one
        self.scanners: dict[str, int] = {}
        """The scanners that were heard, and the stamp of their newest scan (ns)."""

    @property
    def waiting(self) -> int:
        """How many parts wait."""
        return len(self._held)

    @property
    def alone(self) -> bool:
        """Whether each scan is a turn of its own."""
        return len(self._last) == 1

    def add(self, part: Part) -> list[LidarScan]:
        """Take a part; the turns that are whole with it, as scans of the first scanner."""
        whole: list[LidarScan] = []
        stamp_ns = part.scan.stamp_ns
        self.scanners[part.scanner] = max(stamp_ns, self.scanners.get(part.scanner, stamp_ns))
        apart = bool(self._held) and abs(stamp_ns - self._held[0].scan.stamp_ns) > _LONGEST_NS
        if apart or any(part.repeats(other) for other in self._held):
            whole += self.flush()
        elif self._held and stamp_ns - self._end_ns > _PAUSE * self._between_ns > 0:
            whole += self.flush()  # parts come in bursts: a turn is one of them
        if not self._held and self._end_ns:
            self._between_ns = stamp_ns - self._end_ns
        self._end_ns = stamp_ns
        self._held.append(part)
        if self._last and all(any(held.repeats(other) for held in self._held) for other in self._last):
            whole += self.flush()
        return whole

    def flush(self) -> list[LidarScan]:
        """The turn that is not whole, if there is one."""
        if not self._held:
            return []
        parts, self._held, self._last = self._held, [], self._held
        self._first = self._first or parts[0]
        return [together(parts, self._first)]

    def silent(self, seconds: float = 2.0) -> list[str]:
        """The scanners of which nothing came for so long while others sent scans."""
        newest = max(self.scanners.values(), default=0)
        return sorted(name for name, stamp_ns in self.scanners.items() if newest - stamp_ns > seconds * 1e9)


def together(parts: list[Part], first: Part) -> LidarScan:
    """Several scans as one of the scanner ``first``, with the stamp at which the last of the scanners began.

    Where two see a direction, the nearer range counts.
    """
    if len(parts) == 1 and parts[0].scanner == first.scanner:
        return parts[0].scan
    increment = min(abs(part.scan.angle_increment) for part in parts)
    count = min(math.ceil(math.tau / increment - _ROUNDED), _MOST_RAYS)
    increment = math.tau / count
    began_ns = {part.scanner: part.scan.stamp_ns for part in reversed(parts)}
    stamp_ns = max(began_ns.values())
    ranges, offsets = np.full(count, np.nan), np.zeros(count)
    low = first.scan.angle_min
    for part in parts:
        angles, reach, late = _seen_from(part, first.mounting, stamp_ns)
        late = late + _begin_s(part, parts)
        rays = np.rint((angles - low) / increment).astype(np.int64) % count
        known = np.isfinite(reach)
        free = rays[~known & np.isnan(ranges[rays])]
        ranges[free] = reach[~known & np.isnan(ranges[rays])]
        order = np.argsort(-reach[known], kind="stable")  # the nearest is written last
        rays, reach, late = rays[known][order], reach[known][order], late[known][order]
        nearer = ~(ranges[rays] <= reach)
        ranges[rays[nearer]], offsets[rays[nearer]] = reach[nearer], late[nearer]
    farthest = max(part.scan.range_max for part in parts)
    return LidarScan(
        stamp_ns,
        low,
        increment,
        ranges.astype(np.float32),
        0.0,
        farthest,
        0.0,
        first.scan.frame_id,
        offsets if offsets.any() else None,
    )


def _begin_s(part: Part, parts: list[Part]) -> float:
    """When a part began after its stamp (s): sectors that carry one stamp were measured one after the other."""
    scan = part.scan
    first = next(other for other in parts if (other.scanner, other.scan.stamp_ns) == (part.scanner, scan.stamp_ns))
    if first is part or scan.offsets_s is not None:
        return 0.0
    rays = (scan.angle_min - first.scan.angle_min) / scan.angle_increment
    return scan.time_increment * (rays % (math.tau / abs(scan.angle_increment)))


def _seen_from(part: Part, sensor: Mounting, stamp_ns: int) -> tuple[Array, Array, Array]:
    """Angles and ranges ``(rays,)`` of a part as another sensor would have them, and the time of its rays (s).

    Infinite: nothing came back; not a number: not known.
    """
    scan, own = part.scan, part.mounting
    angles = scan.angles
    largest = scan.range_max if 0.0 < scan.range_max < math.inf else math.inf
    reach = scan.ranges.astype(np.float64)
    seen = (reach > max(scan.range_min, 0.0)) & (reach < largest)
    reach = np.where(seen, reach, np.where(reach >= largest, np.inf, np.nan))
    late = scan.ray_offsets_s + (scan.stamp_ns - stamp_ns) * 1e-9
    if own is sensor or (
        own.upside_down == sensor.upside_down and np.array_equal(own.sensor_xyyaw, sensor.sensor_xyyaw)
    ):
        return angles, reach, late
    there = between(sensor.sensor_xyyaw, own.sensor_xyyaw)
    bearing = there[2] + (-angles if own.upside_down else angles)
    x, y = there[0] + reach * np.cos(bearing), there[1] + reach * np.sin(bearing)
    turned = np.where(seen, np.arctan2(y, x), bearing)
    away = np.where(seen, np.hypot(x, y), reach)
    return (-turned if sensor.upside_down else turned), away, late
