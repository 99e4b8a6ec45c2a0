"""Steps between the key scans of a lidar where the poses are known: simulated buildings, and logs with a reference."""

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ngo_estimator.data.relative_step import KeyScanStep
from ngo_estimator.frontend.lidar.lidar_odometry import LidarOdometry, LidarStep
from ngo_recordings.errors import RecordingError
from ngo_recordings.scan_stream import LidarScan, WheelPose
from ngo_sim.building2d import Building2d
from ngo_sim.floor_plans import FloorPlanConfig
from training.data.building_drives import lidar_drive
from training.data.lidar_drives import LidarDrive, ReferencePoses, TruePoses


@dataclass(frozen=True, eq=False)
class KeySteps:
    """The steps between the key scans of one drive.

    Attributes:
        truth: poses of the key scans by the reference ``(keys, 3)``.
        relative, covariance: of each key scan seen from the one before ``(keys - 1, 3)`` and ``(keys - 1, 3, 3)``.
        evidence: of these steps ``(keys - 1, 12)``, columns as in ``STEP_EVIDENCE``.
    """

    truth: np.ndarray
    relative: np.ndarray
    covariance: np.ndarray
    evidence: np.ndarray

    def save(self, path: Path) -> None:
        """Write a ``.npz`` file."""
        np.savez_compressed(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> "KeySteps":
        """Read what ``save`` wrote."""
        with np.load(path) as arrays:
            return cls(**{field.name: arrays[field.name] for field in fields(cls)})


def building_steps(seed: int, length_m: float, aliased: bool, wheels: bool) -> KeySteps:
    """Drive through a building that is drawn from the seed, with its scanner, and its wheels if they are to be used."""
    drive = Building2d(FloorPlanConfig(aliased=aliased)).record(seed, length_m)
    scanner = dataclasses.replace(drive.scanner, increment_error=0.0)  # the angles are known
    return key_steps(lidar_drive(dataclasses.replace(drive, scanner=scanner), f"building_{seed}", ""), wheels)


def key_steps(drive: LidarDrive, wheels: bool = True) -> KeySteps:
    """Run the front end, without learning, over a drive whose poses are known.

    Raises:
        RecordingError: they are not, or the robot does not move.
    """
    if not isinstance(drive.reference, TruePoses | ReferencePoses):
        raise RecordingError(f"{drive.name} has no poses of a mapper; expected a CARMEN log that GMapping corrected")
    keys: list[tuple[LidarStep, KeyScanStep]] = []
    origin_ns = 0
    for step in _steps(LidarOdometry(mounting=drive.mounting), drive.records(wheels)):
        origin_ns = step.origin_stamp_ns
        if step.key is not None:
            keys.append((step, step.key))
    if not keys:
        raise RecordingError("the drive has no key scan after its first scan; expected a robot that moves")
    rows = np.searchsorted(drive.reference.stamps_ns, [origin_ns, *(step.stamp_ns for step, _ in keys)])
    return KeySteps(
        drive.reference.poses_xyyaw[rows],
        np.stack([key.relative_xyyaw for _, key in keys]),
        np.stack([key.covariance for _, key in keys]),
        np.stack([step.evidence for step, _ in keys]),
    )


def _steps(odometry: LidarOdometry, records: Iterable[LidarScan | WheelPose]) -> Iterator[LidarStep]:
    for record in records:
        if isinstance(record, WheelPose):
            odometry.add_wheels(record.stamp_ns, record.pose_xyyaw)
        else:
            odometry.add_scan(record)
            yield from _ready(odometry, at_end=False)
    yield from _ready(odometry, at_end=True)


def _ready(odometry: LidarOdometry, at_end: bool) -> Iterator[LidarStep]:
    while True:
        try:
            yield from odometry.ready(at_end)
            return
        except ValueError:  # a scan without usable rays, which is gone
            continue
