"""A LaserScan as a record, by angles that its message does not contradict."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ngo_recordings.association import header_stamp_ns
from ngo_recordings.errors import RecordingError

_FULL_TURN = 2.0 * math.pi
# Rad; scanners have 50 times this, and a message with a finer one could cost its reader without bound.
LEAST_INCREMENT = 1e-5
# Rad; a scan of more than a turn with a wider one is no scan of a scanner that turns on.
_WIDEST_INCREMENT = 0.1
# Of degrees.
_LARGEST_DEG = 720.0
# Rays by which the ends of a scan may contradict its increment: some drivers count one ray more or less.
_SLACK_RAYS = 1.5


@dataclass(frozen=True)
class LidarScan:
    """A scan in the scanner's frame.

    angle_min, angle_increment: of the rays in the message's order, counter-clockwise about the frame's z; the increment
    is negative where rays run clockwise. ranges ``(rays,)``: float32, m, as recorded, so holes, NaN and values out of
    range_min and range_max (m) are there. time_increment: from ray to ray, s, 0 where unknown. offsets_s ``(rays,)``:
    when each ray was measured, after the stamp, where that is not even; None: as time_increment says. topic: where it
    came from. note: what its message says otherwise, in words.
    """

    stamp_ns: int
    angle_min: float
    angle_increment: float
    ranges: np.ndarray
    range_min: float
    range_max: float
    time_increment: float
    frame_id: str
    offsets_s: np.ndarray | None = None
    topic: str = ""
    note: str = ""

    @property
    def angles(self) -> np.ndarray:
        """Angles of the rays ``(rays,)``, rad."""
        angles: np.ndarray = self.angle_min + self.angle_increment * np.arange(len(self.ranges), dtype=np.float64)
        return angles

    @property
    def ray_offsets_s(self) -> np.ndarray:
        """When each ray was measured, after the stamp, ``(rays,)``, s."""
        if self.offsets_s is not None:
            return self.offsets_s
        return self.time_increment * np.arange(len(self.ranges), dtype=np.float64)

    def hits(self) -> np.ndarray:
        """Ends ``(n, 2)`` of the rays that met something, in the scanner's frame (m)."""
        angles, ranges = self.angles, self.ranges.astype(np.float64)
        hit = np.isfinite(ranges) & (ranges > 0.0) & (ranges >= self.range_min)
        if self.range_max > self.range_min:  # some drivers leave it at 0
            hit &= ranges <= self.range_max
        return ranges[hit, None] * np.column_stack([np.cos(angles[hit]), np.sin(angles[hit])])

    @property
    def sweep_s(self) -> float:
        """From the first ray to the last, s; 0 where it is not known."""
        if self.offsets_s is not None:
            return float(self.offsets_s.max() - self.offsets_s.min())
        return abs(self.time_increment) * len(self.ranges)


@dataclass(frozen=True)
class ScanAngles:
    """The angles of a scan's rays, and a note where the message contradicts itself or is likely wrong.

    likely_increment: what the increment probably is where the message's is doubtful, else None; it is not used unless
    a caller gives it to `scan_stream`. rays: how many count, from the first on; None: all.
    """

    angle_min: float
    angle_increment: float
    note: str | None = None
    likely_increment: float | None = None
    rays: int | None = None


def scan_angles(message: Any, topic: str = "the scan") -> ScanAngles:
    """The angles of a LaserScan, by this rule.

    The message's increment counts while ``angle_min + (n - 1) * increment`` is within 1.5 rays of angle_max, or of the
    same direction a turn further on. Otherwise,
    and where it is 0 or no number, ``(angle_max - angle_min) / (n - 1)`` counts, if that is an increment. An increment
    that spreads n rays over a field of view as if they were n - 1 (180 rays over 180 deg: 1.0056 deg instead of 1 deg),
    or n + 1, contradicts nothing; it counts and is noted. Of a scan of up to two turns the first turn counts. Angles
    that only degrees can be are degrees.

    Raises:
        RecordingError: neither gives angles within a full turn.
    """
    count = len(message.ranges)
    low, high, increment = float(message.angle_min), float(message.angle_max), float(message.angle_increment)
    largest = max(abs(low), abs(high))
    if not (2.0 * _FULL_TURN < largest <= _LARGEST_DEG and is_increment(math.radians(increment), count)):
        return _angles(count, low, high, increment, topic)
    found = _angles(count, math.radians(low), math.radians(high), math.radians(increment), topic)
    return replace(found, note=f"angles of {topic} are in degrees, to {largest:g}: taken so")


def _angles(count: int, low: float, high: float, increment: float, topic: str) -> ScanAngles:
    if not count or not math.isfinite(low) or abs(low) > 2.0 * _FULL_TURN:
        raise RecordingError(f"a scan of {topic} has {count} rays from {low:g} rad on; expected rays, and an angle")
    if _FULL_TURN < 0.99 * abs(increment) * (count - 1) <= 2.0 * _FULL_TURN and abs(increment) < _WIDEST_INCREMENT:
        turn = math.ceil(_FULL_TURN / abs(increment) - 1e-3)
        note = f"a scan of {topic} has {count} rays, more than a full turn: the first {turn} count"
        return ScanAngles(low, increment, note, rays=turn)
    implied = (high - low) / (count - 1) if count > 1 and math.isfinite(high) else 0.0
    if not is_increment(increment, count):
        if not is_increment(implied, count):
            raise RecordingError(
                f"a scan of {topic} has {count} rays {increment:g} rad apart from {low:g} to {high:g} rad; expected "
                "angles within a full turn"
            )
        note = f"the increment of {topic} is {increment:g} rad: its ends count, {math.degrees(implied):.4f} deg"
        return ScanAngles(low, implied, note)
    apart = abs(low + (count - 1) * increment - high)
    given_deg = math.degrees(increment)
    turned = abs(implied + increment) <= _SLACK_RAYS * abs(increment) / count  # half a turn, told the other way round
    wraps = abs(apart - _FULL_TURN) <= _SLACK_RAYS * abs(increment) and not turned
    wraps &= abs(increment) * (count - 1) <= _FULL_TURN + _SLACK_RAYS * abs(increment)
    if count > 1 and apart > _SLACK_RAYS * abs(increment) and is_increment(implied, count) and not wraps:
        counts = -increment if turned else implied  # ends that are a ray off tell the side, and no more
        note = f"the increment of {topic} is {given_deg:.4f} deg and contradicts its ends: {math.degrees(counts):.4f}"
        return ScanAngles(low, counts, f"{note} deg counts")
    if not math.isfinite(high) or (count > 1 and apart > 0.5 * abs(increment)):
        note = f"angle_max of {topic} is {math.degrees(high):.2f} deg, not that of its last ray: the increment counts"
        return ScanAngles(low, increment, note)
    likely = {"less": math.copysign(abs(high - low) / count, increment), "more": increment * count / max(count - 1, 1)}
    for rays, each in likely.items():
        if count > 1 and _is_round(each) and not _is_round(increment):
            note = (
                f"{topic} has {count} rays over {math.degrees(abs(high - low)):.2f} deg, {given_deg:.4f} deg apart: "
                f"likely are {math.degrees(each):.4f} deg, and its field of view one ray {rays}"
            )
            return ScanAngles(low, increment, note, each)
    return ScanAngles(low, increment)


def scan_of(value: Any, topic: str, angle_increment: float | None = None) -> LidarScan:
    """A LaserScan or MultiEchoLaserScan message as a record; of several echoes the first one counts.

    Its angles are those of `scan_angles`, the increment one's own where given.

    Raises:
        RecordingError: the scan has no angles, or no stamp.
    """
    angles = scan_angles(value, topic)
    ranges = value.ranges
    if hasattr(ranges[0], "echoes"):
        ranges = [next(iter(ray.echoes), math.nan) for ray in ranges]
    time_increment = float(value.time_increment)
    low, high = (0.0 if math.isnan(limit) else float(limit) for limit in (value.range_min, value.range_max))
    if low >= high > 0.0:  # between them is no range: neither is known
        low = high = 0.0
    return LidarScan(
        header_stamp_ns(value),
        angles.angle_min,
        angles.angle_increment if angle_increment is None else angle_increment,
        np.asarray(ranges, np.float32)[: angles.rays],
        low,
        high,
        time_increment if math.isfinite(time_increment) else 0.0,
        str(value.header.frame_id).strip("/"),
        topic=topic,
    )


def is_increment(increment: float, count: int) -> bool:
    """Whether rays so far apart are an increment, within a full turn."""
    return abs(increment) >= LEAST_INCREMENT and abs(increment) * (count - 1) <= 1.01 * _FULL_TURN  # not NaN


def _is_round(increment: float) -> bool:
    """Whether an increment divides a degree, or is a multiple of a quarter of one, as scanners' are."""
    degrees = abs(math.degrees(increment))
    quarters, parts = degrees * 4.0, 1.0 / degrees
    return any(value > 0.5 and abs(value - round(value)) < 1e-3 * value for value in (quarters, parts))
