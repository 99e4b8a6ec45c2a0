"""The binary log of MRPT (``rawlog``): frames of one planar scan each, and the motion before each.

Written after MRPT's serialisation: an object is its class's name with its length, a version, its fields and an end
mark. Its programs read pairs of a collection of actions and a frame of observations.
"""

import gzip
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_END = b"\x88"
_STAMP_ORIGIN = 116_444_736 * 10**9  # of a Unix stamp on MRPT's clock, in its units of 100 ns
_SCAN_MATCHING = 1  # as the source of a motion: its covariance is the file's, not MRPT's own
_RANGE_STD_M = 0.01
_LABEL = b"laser"
# MRPT's own deviations of a motion by wheels, as its class of motions has them.
_LEAST_M, _PER_METRE, _PER_RAD = 0.01, 0.01, math.degrees(0.001)
_LEAST_RAD, _RAD_PER_METRE, _RAD_PER_RAD = math.radians(0.2), math.radians(1.0), 0.05


@dataclass(frozen=True, eq=False)
class RawScan:
    """A planar scan as MRPT has it.

    ``laser`` ``(3,)`` is the laser's pose on the robot, looking along the scan's middle. ``ranges`` ``(rays,)`` go from
    right to left, ``returned`` ``(rays,)`` says which of them count, and ``view_rad`` is the angle from first to last.
    """

    laser: np.ndarray
    ranges: np.ndarray
    returned: np.ndarray
    view_rad: float


def write_rawlog(path: Path, stamps_ns: np.ndarray, motions: np.ndarray, scans: Sequence[RawScan]) -> None:
    """Write one scan a frame, at ``stamps_ns`` ``(n,)``, and the ``motions`` ``(n, 3)`` of the robot before each."""
    with gzip.open(path, "wb", compresslevel=1) as stream:
        for stamp_ns, motion, scan in zip(stamps_ns.tolist(), motions, scans, strict=True):
            stamp = struct.pack("<Q", _STAMP_ORIGIN + stamp_ns // 100)
            stream.write(_object("obs::CActionCollection", 0, struct.pack("<I", 1) + _motion(motion, stamp)))
            stream.write(_object("obs::CSensoryFrame", 2, struct.pack("<I", 1) + _scan(scan, stamp)))


def _object(name: str, version: int, fields: bytes) -> bytes:
    full = f"mrpt::{name}".encode()
    return bytes((len(full) | 0x80,)) + full + bytes((version,)) + fields + _END


def _motion(motion: np.ndarray, stamp: bytes) -> bytes:
    way, turn = math.hypot(motion[0], motion[1]), abs(motion[2])
    metres = (_LEAST_M + _PER_METRE * way + _PER_RAD * turn) ** 2
    radians = (_LEAST_RAD + _RAD_PER_METRE * way + _RAD_PER_RAD * turn) ** 2
    mean = _object("poses::CPose2D", 1, struct.pack("<3d", *motion))
    gaussian = _object("poses::CPosePDFGaussian", 2, mean + struct.pack("<6d", metres, 0.0, 0.0, metres, 0.0, radians))
    nothing_more = struct.pack("<?ff?ii", False, 0.0, 0.0, False, 0, 0)  # no velocities, no encoders
    return _object(
        "obs::CActionRobotMovement2D", 6, struct.pack("<I", _SCAN_MATCHING) + gaussian + nothing_more + stamp
    )  # fmt: skip


def _scan(scan: RawScan, stamp: bytes) -> bytes:
    laser, ranges, returned = scan.laser, scan.ranges, scan.returned
    cosine, sine = math.cos(laser[2]), math.sin(laser[2])
    rotation = (cosine, -sine, 0.0, sine, cosine, 0.0, 0.0, 0.0, 1.0)
    pose = _object("poses::CPose3D", 3, struct.pack("<12d", laser[0], laser[1], 0.0, *rotation))
    farthest = float(ranges[returned].max(initial=1.0)) + 1.0
    return _object(
        "obs::CObservation2DRangeScan",
        7,
        b"".join(
            (
                struct.pack("<f?f", scan.view_rad, True, farthest),
                pose,
                struct.pack("<I", len(ranges)),
                np.where(returned, ranges, 0.0).astype("<f4").tobytes(),
                returned.astype(np.uint8).tobytes(),
                struct.pack("<f", _RANGE_STD_M),
                stamp,
                struct.pack("<fI", 0.0, len(_LABEL)),
                _LABEL,
                struct.pack("<d?", 0.0, False),
            )
        ),
    )
