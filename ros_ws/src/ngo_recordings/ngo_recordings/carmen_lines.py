"""The lines of CARMEN logs: scans and odometry as numbers.

Formats (header of CARMEN's logger, carmen.sourceforge.net/logger_playback.html), n ranges and m remissions:

    FLASER n r_1..r_n laser_x laser_y laser_theta robot_x robot_y robot_theta stamp host logger_stamp
    RAWLASER1 type start fov increment max_range accuracy mode n r_1..r_n m i_1..i_m stamp host logger_stamp
    ROBOTLASER1 (as RAWLASER1 up to i_m) laser_x .. robot_theta tv rv forward side turn_axis stamp host logger_stamp
    ODOM x y theta tv rv accel stamp host logger_stamp
    PARAM robot_frontlaser_offset value host logger_stamp

Older ROBOTLASER lines have neither remissions nor turn_axis. Metres, radians, seconds.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

OFFSET_PARAMETER = "robot_frontlaser_offset"
NO_RETURN_M = 81.9
"""A SICK LMS writes this and above where nothing came back."""

Pose3 = tuple[float, float, float]

_SCAN = re.compile(rb"(FLASER|ROBOTLASER\d+|RAWLASER\d+)$")
_HOST_OF_GMAPPING = b"pippo"
_LATEST_S = 2.0**31
_FARTHEST_M = 1e7


class BadLine(ValueError):
    """A line of a known kind is not what its kind says."""


@dataclass(frozen=True)
class ScanLine:
    """A scan, counter-clockwise; no return is +inf. Poses are None in RAWLASER lines.

    kind: first word. ranges: float32 ``(n,)``, m. range_max: None where the line does not say it. stamp_s,
    logger_stamp_s: NaN where the line has none that may be one. gmapping: written by GMapping.
    """

    kind: str
    ranges: np.ndarray
    angle_min: float
    angle_increment: float
    range_max: float | None
    laser_pose: Pose3 | None
    robot_pose: Pose3 | None
    stamp_s: float
    logger_stamp_s: float
    gmapping: bool


@dataclass(frozen=True)
class OdometryLine:
    """A pose of the wheels, with the velocities forward (m/s) and counter-clockwise (rad/s)."""

    pose: Pose3
    forward: float
    turn: float
    stamp_s: float
    logger_stamp_s: float


@dataclass(frozen=True)
class LaserOffset:
    """How far ahead of the robot's centre the front laser sits, m, as the robot's parameters say."""

    forward: float


@dataclass(frozen=True)
class GMappingMark:
    """A line that only GMapping writes."""


@dataclass(frozen=True)
class LeftOut:
    """A scan that is not read: of the rear laser."""

    kind: str


Line = ScanLine | OdometryLine | LaserOffset | GMappingMark | LeftOut


def parse_line(line: bytes) -> Line | None:
    """What a line says; None of a comment, an empty line, or a kind that is of no use here.

    Raises BadLine where it is damaged.
    """
    words = line.split()
    if not words:
        return None
    kind = words[0]
    if _SCAN.match(kind):
        return _flaser(words) if kind == b"FLASER" else _configured(words)
    if kind == b"ODOM":
        return _odometry(words)
    if kind == b"RLASER":
        return LeftOut("RLASER")
    if kind == b"NEFF":
        return GMappingMark()
    if kind == b"PARAM" and len(words) >= 3 and words[1] == OFFSET_PARAMETER.encode():
        return LaserOffset(_numbers(words[2:3])[0])
    return None


def _flaser(words: list[bytes]) -> ScanLine:
    count = _count(words, 1)
    poses, tail = _numbers(words[2 + count : 8 + count]), words[8 + count :]
    if len(poses) != 6 or len(tail) > 3:
        raise BadLine(f"FLASER of {count} ranges has {len(words)} words; expected {count + 11}")
    angle_min, increment = _guessed_angles(count)
    stamp_s, logger_stamp_s, host = _tail(tail)
    laser, robot = _poses(poses)
    ranges = _ranges(words[2 : 2 + count], NO_RETURN_M)
    gmapping = host == _HOST_OF_GMAPPING
    return ScanLine("FLASER", ranges, angle_min, increment, None, laser, robot, stamp_s, logger_stamp_s, gmapping)


def _configured(words: list[bytes]) -> ScanLine:
    """Of a line that says its own angles."""
    kind = words[0].decode()
    count = _count(words, 8)
    start, fov, increment, range_max = _numbers(words[2:6])
    rest = words[9 + count :]
    if increment == 0.0 or abs(increment) * max(count - 1, 1) > 2.1 * math.pi or abs(start) > 2.1 * math.pi:
        if count < 2 or not 0.0 < abs(fov) <= 2.1 * math.pi:
            raise BadLine(f"{kind} of {count} rays has start {start:g}, field of view {fov:g}, increment {increment:g}")
        increment = fov / (count - 1)
    if range_max <= 0.0:
        raise BadLine(f"{kind} has a maximum range of {range_max:g} m; expected more than 0")
    after = 0 if kind.startswith("RAW") else 11
    remissions = int(rest[0]) if rest and rest[0].isdigit() else -1
    if remissions >= 0 and len(rest) == 1 + remissions + after + 3:
        rest = rest[1 + remissions :]
    elif len(rest) not in ((3,) if not after else (after + 2, after + 3)):
        raise BadLine(f"{kind} of {count} ranges has {len(words)} words, which fits no version of the format")
    laser, robot = _poses(_numbers(rest[:6])) if after else (None, None)
    stamp_s, logger_stamp_s, _ = _tail(rest[-3:])
    ranges = _ranges(words[9 : 9 + count], range_max)
    return ScanLine(kind, ranges, start, increment, range_max, laser, robot, stamp_s, logger_stamp_s, gmapping=False)


def _odometry(words: list[bytes]) -> OdometryLine:
    if not 7 <= len(words) <= 10:
        raise BadLine(f"ODOM has {len(words)} words; expected 10")
    values = _numbers(words[1:7])
    stamp_s, logger_stamp_s, _ = _tail(words[7:])
    return OdometryLine(_pose(values[:3]), values[3], values[4], stamp_s, logger_stamp_s)


def _count(words: list[bytes], index: int) -> int:
    """Number of ranges, which must be there."""
    text = words[index] if len(words) > index else b""
    if not text.isdigit() or len(text) > 6 or not 1 <= int(text) < len(words) - index:
        raise BadLine(f"{words[0].decode()} says {_shown(text)} ranges and has {max(len(words) - index - 1, 0)} words")
    return int(text)


def _ranges(words: list[bytes], no_return_m: float) -> np.ndarray:
    try:
        ranges = np.array([float(word) for word in words], np.float64)
    except ValueError as error:
        raise BadLine(f"a range is no number ({error})") from None
    # NaN compares false: it is no distance.
    ranges[~(ranges < no_return_m)] = np.inf
    return ranges.astype(np.float32)


def _numbers(words: list[bytes]) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise BadLine(f"a number was expected ({error})") from None
    if not all(map(math.isfinite, values)):
        raise BadLine("a number is not finite")
    return values


def _poses(values: list[float]) -> tuple[Pose3, Pose3]:
    return _pose(values[:3]), _pose(values[3:])


def _pose(values: list[float]) -> Pose3:
    x, y, theta = values
    if max(abs(x), abs(y), abs(theta)) > _FARTHEST_M:
        raise BadLine(f"a pose is ({x:g}, {y:g}, {theta:g}); expected metres and radians")
    return x, y, math.remainder(theta, 2.0 * math.pi)


def _tail(words: list[bytes]) -> tuple[float, float, bytes]:
    """Stamp, the logger's stamp and host; NaN for stamps that are not there or cannot be any."""
    return _stamp(words[:1]), _stamp(words[2:3]), words[1] if len(words) > 1 else b""


def _stamp(words: list[bytes]) -> float:
    try:
        stamp_s = float(words[0])
    except (IndexError, ValueError):
        return math.nan
    return stamp_s if 0.0 <= stamp_s < _LATEST_S else math.nan


def _guessed_angles(count: int) -> tuple[float, float]:
    """First angle and increment of n rays without a configuration, as CARMEN takes them; a half circle otherwise."""
    if count in (180, 181):
        degrees = 1.0
    elif count in (360, 361):
        degrees = 0.5
    elif count in (400, 401):
        return math.radians(-50.0), math.radians(0.25)
    else:
        degrees = 180.0 / max(count - 1, 1)
    return -math.pi / 2.0, math.radians(degrees)


def _shown(text: bytes) -> str:
    return repr(text[:20].decode(errors="replace"))
