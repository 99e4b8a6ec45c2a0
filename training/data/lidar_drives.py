"""Drives of a robot with a 2D lidar, from whichever source: what it measured, and what is known of where it was."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose


@dataclass(frozen=True, eq=False)
class TruePoses:
    """The truth of a simulation: poses ``(n, 3)`` of the robot at each scan of ``stamps_ns`` ``(n,)``."""

    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray


@dataclass(frozen=True, eq=False)
class ReferencePoses:
    """Poses ``(n, 3)`` that a mapper gave to scans at ``stamps_ns`` ``(n,)``: good to centimetres, not the truth."""

    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray


@dataclass(frozen=True, eq=False)
class Relations:
    """Relative poses that people checked, of the Freiburg SLAM benchmark (Kuemmerle et al. 2009).

    ``stamps_s`` ``(n, 2)``; ``relative_xyyaw`` ``(n, 3)``: the robot at the second stamp, seen from where it was at the
    first.
    """

    stamps_s: np.ndarray
    relative_xyyaw: np.ndarray


_START_NS = 1_000_000_000  # of simulated stamps: 0 means unknown in ROS


def simulated_stamps_ns(stamps_s: np.ndarray) -> np.ndarray:
    """Stamps of a simulated drive from its times (s), both ``(n,)``."""
    return _START_NS + np.rint(stamps_s * 1e9).astype(np.int64)


Reference = TruePoses | ReferencePoses | Relations


@dataclass(frozen=True, eq=False)
class LidarDrive:
    """What a robot measured, scans and wheel poses each in order of time, and what is known of its poses, if anything.

    ``identity`` says in words all that the drive follows from: two drives of one identity are the same.
    """

    name: str
    identity: str
    scans: tuple[LidarScan, ...]
    wheels: tuple[WheelPose, ...]
    mounting: Mounting
    reference: Reference | None

    def records(self, with_wheels: bool = True) -> Iterator[LidarScan | WheelPose]:
        """Scans and wheel poses in order of their stamps; of the same stamp wheels come first."""
        wheels: Iterable[LidarScan | WheelPose] = self.wheels if with_wheels else ()
        yield from heapq.merge(wheels, self.scans, key=lambda record: record.stamp_ns)

    @property
    def scan_stamps_ns(self) -> np.ndarray:
        """Stamps of the scans ``(scans,)``."""
        return np.array([scan.stamp_ns for scan in self.scans], dtype=np.int64)

    @property
    def duration_s(self) -> float:
        """From the first scan to the last."""
        return (self.scans[-1].stamp_ns - self.scans[0].stamp_ns) * 1e-9
