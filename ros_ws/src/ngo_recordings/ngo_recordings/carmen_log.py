"""One CARMEN log (.log, .clf, gzipped or not) as topics of ROS messages."""

from __future__ import annotations

import gzip
import math
import os
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from ngo_recordings.bounds import check_regular
from ngo_recordings.carmen_lines import (
    NO_RETURN_M,
    BadLine,
    GMappingMark,
    LaserOffset,
    LeftOut,
    OdometryLine,
    ScanLine,
    parse_line,
)
from ngo_recordings.carmen_messages import laser_scan, odometry, pose_stamped, static_transform
from ngo_recordings.carmen_poses import interpret
from ngo_recordings.carmen_stamps import choose_stamps, stray_lines
from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import Stored

SCAN_TOPIC = "/scan"
ODOMETRY_TOPIC = "/odom"
CORRECTED_TOPIC = "/corrected_pose"
STATIC_TOPIC = "/tf_static"

ENCODING = "objects"

_MAX_LINE_BYTES = 2**20
_MAX_LOG_BYTES = 4 * 2**30
# A text of numbers shrinks by 3 to 10; beyond this much text, more than this is no log.
_FREE_BYTES, _MAX_RATIO = 64 * 2**20, 200
_FREE_LINES, _MAX_USELESS = 100_000, 50
_BAD_SHARE = 0.1
# Scans of so many numbers stay in memory (16 MB): then they need no second reading. A scan's other fields take as much
# as 160 rays.
_MOST_KEPT_NUMBERS, _NUMBERS_OF_A_SCAN = 4_000_000, 160
# What a SICK LMS writes for no return, by its settings, m; logs differ in the last digits.
_LIMITS_M = (8.191, 16.383, 32.767, 51.15, NO_RETURN_M)
_NEAR_LIMIT = 0.01
_LIMIT_SHARE = 1e-3
_BIN_M = 0.05

_TYPES = {
    SCAN_TOPIC: "sensor_msgs/msg/LaserScan",
    ODOMETRY_TOPIC: "nav_msgs/msg/Odometry",
    CORRECTED_TOPIC: "geometry_msgs/msg/PoseStamped",
    STATIC_TOPIC: "tf2_msgs/msg/TFMessage",
}


class CarmenLog:
    """A log as topics: /scan (frame laser), /odom, and where the log has them /corrected_pose and /tf_static.

    /odom is raw wheel odometry, of ODOM lines and of scans, its velocity NaN where the log has none. /corrected_pose
    (frame map) is where a mapper put the robot at each scan: good, but not the truth. `carmen_poses.interpret` says
    which is which. Scans are those of FLASER lines, else of ROBOTLASER, else of RAWLASER lines with the lowest number.

    The file is read once to index it, and again for scans where it has many: memory holds poses, and the scans of a
    short log. unfinished: the last line, or the gzip stream, is cut off. stamps_made: no stamps of the log can be used,
    and scans are MADE_PERIOD_S apart. notes: what else a person should know, one sentence each.

    Raises:
        RecordingError: the file has no line of such a log, a line is too long, or a tenth of the scans is damaged.
    """

    def __init__(self, path: Path) -> None:
        check_regular(path)
        self.path = path
        self.unfinished = False
        self.stamps_made = False
        self.topics: dict[str, Stored] = {}
        index = _Index(path)
        self.unfinished = index.unfinished
        self._kind, self._limit_m, self._kept = index.kind, index.limit_m, index.kept
        self._is_scan = np.array([row[0] for row in index.rows])
        poses = np.array([row[1] for row in index.rows], np.float64).reshape(-1, 2, 3)
        self._speeds = [row[2] for row in index.rows]
        self._poses = interpret(self._is_scan, poses[:, 0], poses[:, 1], index.gmapping)
        stamps = np.array([row[3] for row in index.rows], np.float64).reshape(-1, 2)
        self._stamps_ns, self.stamps_made, note = choose_stamps(self._is_scan, stamps)
        if not self.stamps_made:
            stray = stray_lines(self._is_scan, self._stamps_ns) & np.isfinite(self._poses.odometry[:, 0])
            if stray.any():
                self._poses.odometry[stray] = np.nan
                self._stamps_ns[stray] = self._stamps_ns[~stray].min()
                note = (*note, f"{stray.sum()} ODOM lines are left out: their stamps do not fit the scans around them")
        self._log_ns = np.maximum.accumulate(self._stamps_ns)
        self._mounting = self._poses.mounting
        if self._mounting is None and index.offset_m is not None:
            self._mounting = np.array([index.offset_m, 0.0, 0.0])
        self.notes = tuple(f"{path}: {text}" for text in (*note, *index.notes, *self._poses.notes))
        self._count()

    def close(self) -> None:
        """Nothing stays open."""

    def messages(self, names: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, log time and message of these topics; a scan comes after the odometry and the pose at its stamp."""
        if STATIC_TOPIC in names and self._mounting is not None:
            yield STATIC_TOPIC, int(self._log_ns[0]), static_transform(int(self._stamps_ns[0]), self._mounting)
        scans = self._scans() if SCAN_TOPIC in names else None
        for row in range(len(self._is_scan)):
            stamp_ns, log_ns = int(self._stamps_ns[row]), int(self._log_ns[row])
            if ODOMETRY_TOPIC in names and self._has(self._poses.odometry, row):
                speed = self._speeds[row] if self._poses.speeds_known else (math.nan, math.nan)
                yield ODOMETRY_TOPIC, log_ns, odometry(stamp_ns, self._poses.odometry[row].tolist(), speed)
            if CORRECTED_TOPIC in names and self._has(self._poses.corrected, row):
                yield CORRECTED_TOPIC, log_ns, pose_stamped(stamp_ns, self._poses.corrected[row].tolist())
            if scans is not None and self._is_scan[row]:
                scan = next(scans, None)
                if scan is None:
                    raise RecordingError(f"{self.path} has changed while it was read: open it again")
                yield SCAN_TOPIC, log_ns, laser_scan(stamp_ns, scan, self._limit_m)

    def _scans(self) -> Iterator[ScanLine]:
        if self._kept is not None:
            yield from self._kept
            return
        kind = [self._kind.encode()]
        for _, line in _lines(self.path):
            if line.split(None, 1)[:1] == kind:
                try:
                    scan = parse_line(line)
                except BadLine:
                    continue
                if isinstance(scan, ScanLine):
                    yield scan

    @staticmethod
    def _has(poses: np.ndarray, row: int) -> bool:
        return not math.isnan(poses[row, 0])

    def _count(self) -> None:
        """Topics with counts and times."""
        odometry, corrected = (np.isfinite(part[:, 0]) for part in (self._poses.odometry, self._poses.corrected))
        static = np.zeros(len(self._is_scan), bool)
        static[0] = self._mounting is not None
        shown = {SCAN_TOPIC: self._is_scan, ODOMETRY_TOPIC: odometry, CORRECTED_TOPIC: corrected, STATIC_TOPIC: static}
        for name, rows in shown.items():
            if rows.any():
                times = self._log_ns[rows]
                self.topics[name] = Stored(_TYPES[name], "", ENCODING, len(times), int(times[0]), int(times[-1]))


class _Index:
    """One pass over a log: which lines are good, and all of them but the ranges."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.gmapping, self.unfinished = False, False
        self.offset_m: float | None = None
        # Kind, poses, speeds, stamps.
        found: list[tuple[str, Any, tuple[float, float], tuple[float, float]]] = []
        self._histogram = np.zeros(int(NO_RETURN_M / _BIN_M) + 1, np.int64)  # of the ranges of FLASER lines
        bad: list[tuple[int, str, bool]] = []
        left_out: Counter[str] = Counter()
        guessed: set[int] = set()
        kept: list[ScanLine] = []
        kept_numbers = 0
        number, ended = 0, True
        for number, line in _lines(path, self):
            ended = line.endswith(b"\n")
            if number > _FREE_LINES and number > _MAX_USELESS * len(found):
                raise RecordingError(
                    f"{path}, line {number}: of {number} lines {len(found)} are scans or odometry: no CARMEN log"
                )
            try:
                parsed = parse_line(line)
            except BadLine as error:
                bad.append((number, str(error), not line.startswith((b"ODOM", b"PARAM"))))
                continue
            if isinstance(parsed, ScanLine):
                found.append(self._scan_row(parsed))
                kept_numbers += len(parsed.ranges) + _NUMBERS_OF_A_SCAN
                if kept_numbers <= _MOST_KEPT_NUMBERS:
                    kept.append(parsed)
                else:
                    kept.clear()
                if parsed.kind == "FLASER" and len(parsed.ranges) not in (180, 181, 360, 361, 400, 401):
                    guessed.add(len(parsed.ranges))
            elif isinstance(parsed, OdometryLine):
                stamps = (parsed.stamp_s, parsed.logger_stamp_s)
                found.append(("", (parsed.pose, parsed.pose), (parsed.forward, parsed.turn), stamps))
            elif isinstance(parsed, LaserOffset):
                self.offset_m = parsed.forward
            elif isinstance(parsed, GMappingMark):
                self.gmapping = True
            elif isinstance(parsed, LeftOut):
                left_out[parsed.kind] += 1
        if bad and bad[-1][0] == number and not ended:
            self.unfinished = True
        self.kind = min((row[0] for row in found if row[0]), key=_preference, default="")
        self.kept = [scan for scan in kept if scan.kind == self.kind] if kept_numbers <= _MOST_KEPT_NUMBERS else None
        left_out.update(row[0] for row in found if row[0] not in ("", self.kind))
        self.rows = [(row[0] != "", *row[1:]) for row in found if row[0] in ("", self.kind)]
        self._check(bad)
        self.limit_m = self._limit()
        self.notes = [f"{count} {kind} lines are left out" for kind, count in sorted(left_out.items())]
        if bad:
            self.notes.append(f"{len(bad)} damaged lines are left out, the first is line {bad[0][0]}: {bad[0][1]}")
        if guessed:
            rays = ", ".join(map(str, sorted(guessed)))
            self.notes.append(f"FLASER lines do not say their angles: {rays} rays are taken to span 180 deg")
        if self.limit_m is not None and self.limit_m < NO_RETURN_M * (1.0 - 2.0 * _NEAR_LIMIT):
            self.notes.append(f"ranges from {self.limit_m:.2f} m on are the scanner's sign for no return")

    def _scan_row(self, scan: ScanLine) -> tuple[str, Any, tuple[float, float], tuple[float, float]]:
        self.gmapping |= scan.gmapping
        if scan.kind == "FLASER":
            bins = np.minimum(np.maximum(scan.ranges, 0.0) / _BIN_M, NO_RETURN_M / _BIN_M).astype(np.int64)
            self._histogram += np.bincount(bins, minlength=len(self._histogram))
        nothing = (math.nan,) * 3
        poses = (scan.laser_pose or nothing, scan.robot_pose or nothing)
        return scan.kind, poses, (math.nan, math.nan), (scan.stamp_s, scan.logger_stamp_s)

    def _check(self, bad: list[tuple[int, str, bool]]) -> None:
        if not self.rows and not bad:
            raise RecordingError(f"{self.path} has no FLASER, ROBOTLASER, RAWLASER or ODOM line: is it a CARMEN log?")
        total = len(self.rows) + len(bad)
        scans = sum(row[0] for row in self.rows)
        bad_scans = sum(of_scan for *_, of_scan in bad)
        if not self.rows or len(bad) > max(1, _BAD_SHARE * total) or bad_scans > max(1, _BAD_SHARE * scans):
            number, reason, _ = bad[0]
            raise RecordingError(
                f"{self.path}, line {number}: {reason}; {len(bad)} of {total} lines are damaged: copy the log again"
            )

    def _limit(self) -> float | None:
        """Range from which a FLASER's rays are no return, by how they pile up at a value that a SICK writes for it."""
        if self.kind != "FLASER":
            return None
        counts = self._histogram
        for limit_m in _LIMITS_M:
            low, high = (int(limit_m * (1.0 + sign * _NEAR_LIMIT) / _BIN_M) for sign in (-1.0, 1.0))
            at_limit = counts[low : high + 1].sum()
            beyond = counts[high + 1 :].sum()
            below = counts[2 * low - high - 1 : low].sum()
            if at_limit > max(10, 10 * below, _LIMIT_SHARE * counts.sum()) and beyond <= _LIMIT_SHARE * at_limit:
                return low * _BIN_M
        return NO_RETURN_M


def _preference(kind: str) -> tuple[int, int]:
    """Scans with poses before scans without, then the lowest number."""
    name = kind.rstrip("0123456789")
    return ("FLASER", "ROBOTLASER", "RAWLASER").index(name), int(kind[len(name) :] or 0)


def _lines(path: Path, index: _Index | None = None) -> Iterator[tuple[int, bytes]]:
    """Lines with their numbers, from 1 on; a gzip stream that is cut off ends with its last line."""
    number = 0
    try:
        with path.open("rb") as stream:
            packed = stream.read(2) == b"\x1f\x8b"
            stream.seek(0)
            size = os.fstat(stream.fileno()).st_size
            most = min(_MAX_LOG_BYTES, max(_FREE_BYTES, _MAX_RATIO * size)) if packed else _MAX_LOG_BYTES
            text = cast(BinaryIO, gzip.GzipFile(fileobj=stream)) if packed else stream
            total = 0
            while line := text.readline(_MAX_LINE_BYTES + 1):
                number += 1
                total += len(line)
                if len(line) > _MAX_LINE_BYTES:
                    raise RecordingError(f"{path}, line {number}: longer than {_MAX_LINE_BYTES} bytes: no CARMEN log")
                if total > most:
                    raise RecordingError(f"{path}, line {number}: unpacks to more than {most} bytes: no CARMEN log")
                yield number, line
    except EOFError:
        if index is not None:
            index.unfinished = True
    except (OSError, zlib.error) as error:
        reason = " ".join(str(error).split())
        raise RecordingError(f"{path} is damaged after line {number} ({reason}): copy it again") from None
