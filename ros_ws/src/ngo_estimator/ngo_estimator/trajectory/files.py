"""Trajectories as text files that evo and others read: TUM and KITTI.

| Ending | What a file holds |
|---|---|
| ``.tum``, ``.txt`` | a pose a line, ``timestamp tx ty tz qx qy qz qw`` (s, m) |
| ``.kitti`` | a pose a line, the upper 3 x 4 of its matrix, row by row |

The KITTI format has no place for stamps: they lie beside it in ``NAME.times.txt``, a line each, in seconds. Its poses
are those of the robot's base (x forward, y left), as in the other formats; KITTI's own are of a camera.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from ngo_common.files import read_file, write_together
from ngo_estimator.trajectory.save_path import check_replaceable

ENDINGS = (".tum", ".txt", ".kitti")
TUM_ENDINGS = (".tum", ".txt")

_NS = 1_000_000_000
_LONGEST_QUATERNION = 1e100  # the square of a longer one may overflow
_END_OF_TIME_S = (2**63 - 1) // _NS  # nanoseconds of a later stamp do not fit into 64 bits
_KITTI, _TIMES = ".kitti", ".times.txt"


@dataclass(frozen=True)
class SpatialPoses:
    """Poses in space: ``stamps_ns`` ``(n,)`` int64, ``positions_xyz`` ``(n, 3)`` m, ``quaternions_xyzw`` ``(n, 4)``."""

    stamps_ns: np.ndarray
    positions_xyz: np.ndarray
    quaternions_xyzw: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def from_planar(cls, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> "SpatialPoses":
        """Poses ``(n, 3)`` of the plane z = 0."""
        half_yaw, zero = 0.5 * poses_xyyaw[:, 2], np.zeros(len(poses_xyyaw))
        return cls(
            np.asarray(stamps_ns),
            np.column_stack((poses_xyyaw[:, :2], zero)),
            np.column_stack((zero, zero, np.sin(half_yaw), np.cos(half_yaw))),
        )

    def planar(self) -> np.ndarray:
        """Poses ``(n, 3)`` seen from above: x, y, and the heading of the forward axis."""
        x, y, z, w = self.quaternions_xyzw.T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return np.column_stack((self.positions_xyz[:, :2], yaw))


def write_trajectory(path: Path, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> list[Path]:
    """Write a trajectory in the format that the file's ending says, all at once or not at all.

    Args:
        path: a file that ends in one of ``ENDINGS``, in a folder that exists.
        stamps_ns: ``(frames,)`` int64.
        poses_xyyaw: ``(frames, 3)``.

    Returns:
        The files written: ``path``, and for ``.kitti`` the one of the stamps.

    Raises:
        ValueError: another ending, no pose to write, or something at its place that is no regular file.
        OSError: a file cannot be written; those that were there before still are.
    """
    return write_lines(trajectory_lines(path, stamps_ns, poses_xyyaw))


def trajectory_lines(path: Path, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> dict[Path, Iterator[str]]:
    """The lines of each file that ``write_trajectory`` writes; raises ``ValueError`` as that does."""
    if path.suffix not in ENDINGS:
        raise ValueError(f"file is '{path}'; allowed: a name that ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    if len(stamps_ns) == 0:
        raise ValueError("the trajectory is empty; nothing was written")
    if len(stamps_ns) != len(poses_xyyaw):
        raise ValueError(f"stamps are {len(stamps_ns)} and poses {len(poses_xyyaw)}; expected as many")
    if path.suffix == _KITTI:
        times = (seconds(stamp) for stamp in stamps_ns.tolist())
        return {path.with_suffix(_TIMES): times, path: _kitti_lines(poses_xyyaw)}
    return {path: tum_lines(stamps_ns, poses_xyyaw)}


def seconds(stamp_ns: int) -> str:
    """A stamp in seconds, to the nanosecond."""
    # Stamps of today have 19 digits in ns, more than a float64 holds: seconds and nanoseconds are written as integers.
    return f"{stamp_ns // _NS}.{stamp_ns % _NS:09d}"


def write_tum(path: Path, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> None:
    """Write the TUM format, as ``write_trajectory`` does."""
    if path.suffix not in TUM_ENDINGS:
        raise ValueError(f"file is '{path}'; allowed: a name that ends in {' or '.join(TUM_ENDINGS)}")
    write_trajectory(path, stamps_ns, poses_xyyaw)


def read_tum(path: Path) -> SpatialPoses:
    """Read a file in the TUM format; lines that begin with ``#`` are comments.

    Raises:
        ValueError: a line that is not eight finite numbers, an orientation of no length, a stamp that is not later
            than the one before it, or no pose at all; it names file and line.
        OSError: the file cannot be read.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    try:
        text = read_file(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text ({error.reason}); expected a TUM file") from None
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}, line {number}"
        try:
            stamp, row = Decimal(words[0]), [float(word) for word in words[1:]]
        except (InvalidOperation, ValueError):
            raise ValueError(f"{where} is '{line[:80]}'; expected numbers: timestamp tx ty tz qx qy qz qw") from None
        if len(row) != 7 or not stamp.is_finite() or not np.isfinite(row).all():
            raise ValueError(f"{where} has {len(words)} numbers; expected 8 that are finite")
        if not 0.0 < math.hypot(*row[3:]) < _LONGEST_QUATERNION:
            raise ValueError(f"{where} has the orientation {' '.join(words[4:])}; expected a quaternion qx qy qz qw")
        if not 0 <= stamp < _END_OF_TIME_S:
            raise ValueError(f"{where} has the stamp {words[0][:40]}; expected seconds from 0 to {_END_OF_TIME_S}")
        stamps.append(int((stamp * _NS).to_integral_value()))
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            raise ValueError(f"{where} has the stamp {words[0]}; expected one later than in the line before")
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} has no poses; expected lines of timestamp tx ty tz qx qy qz qw")
    values = np.array(rows)
    quaternions = values[:, 3:] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    return SpatialPoses(np.array(stamps, np.int64), values[:, :3], quaternions)


def tum_lines(stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> Iterator[str]:
    """The lines of a file in the TUM format, of poses ``(n, 3)``."""
    half_yaw = 0.5 * poses_xyyaw[:, 2]
    values = np.column_stack((poses_xyyaw[:, :2], np.sin(half_yaw), np.cos(half_yaw)))
    for stamp, (x, y, qz, qw) in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        yield f"{seconds(stamp)} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}"


def _kitti_lines(poses_xyyaw: np.ndarray) -> Iterator[str]:
    values = np.column_stack((poses_xyyaw[:, :2], np.cos(poses_xyyaw[:, 2]), np.sin(poses_xyyaw[:, 2])))
    for x, y, cos, sin in values.tolist():
        yield f"{cos!r} {-sin!r} 0 {x!r} {sin!r} {cos!r} 0 {y!r} 0 0 1 0"


def write_lines(contents: Mapping[Path, Iterable[str]]) -> list[Path]:
    """Write files line by line, all of them or none; raises as ``write_trajectory`` does."""
    for path in contents:
        check_replaceable(path)
    return write_together({path: (f"{line}\n".encode() for line in lines) for path, lines in contents.items()})
