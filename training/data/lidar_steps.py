"""Steps between the key scans of a lidar where the poses are known: simulated buildings, and logs with a reference."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ngo_estimator.data.relative_step import KeyScanStep
from ngo_estimator.frontend.lidar.lidar_odometry import LidarOdometry, LidarStep
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.association import header_stamp_ns, ros_pose
from ngo_recordings.carmen_log import CORRECTED_TOPIC
from ngo_recordings.errors import RecordingError
from ngo_recordings.mounting import find_mounting
from ngo_recordings.recording import open_recording
from ngo_recordings.scan_stream import LidarScan, WheelPose, scan_stream
from ngo_recordings.topics import TopicArguments, choose_topics
from ngo_sim.building2d import Building2d, BuildingDrive
from ngo_sim.floor_plans import FloorPlanConfig

_START_NS = 10**9


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
    scanner = drive.scanner
    sensor = np.array((scanner.laser_x_m, scanner.laser_y_m, np.radians(scanner.laser_yaw_deg)))
    stamps_ns = np.array([_stamp_ns(stamp_s) for stamp_s in drive.stamps_s])
    mounting = Mounting(sensor, scanner.upside_down)
    return key_steps(building_records(drive, wheels), mounting, stamps_ns, drive.true_poses_xyyaw)


def building_records(drive: BuildingDrive, wheels: bool = True) -> Iterator[LidarScan | WheelPose]:
    """Scans and wheel poses of a drive in order of time."""
    scanner, angles = drive.scanner, drive.scanner.angles_rad
    per_ray_s = scanner.sweep * scanner.scan_period_s / len(angles)
    reading = 0
    for k, stamp_s in enumerate(drive.stamps_s):
        while wheels and reading < len(drive.wheel_stamps_s) and drive.wheel_stamps_s[reading] <= stamp_s:
            yield WheelPose(_stamp_ns(drive.wheel_stamps_s[reading]), drive.wheel_poses_xyyaw[reading])
            reading += 1
        yield LidarScan(
            _stamp_ns(stamp_s), float(angles[0]), float(angles[1] - angles[0]), drive.ranges_m[k],
            scanner.range_min_m, scanner.range_max_m, per_ray_s, "laser",
        )  # fmt: skip


def log_steps(path: Path) -> KeySteps:
    """Steps along a CARMEN log; the poses that a mapper wrote into it are the reference.

    Raises:
        RecordingError: it cannot be read, or has no such poses.
    """
    with open_recording([path]) as recording:
        if CORRECTED_TOPIC not in recording.topics:
            raise RecordingError(f"{path} has no poses of a mapper; expected a CARMEN log that GMapping corrected")
        stamps, poses = [], []
        for message in recording.messages([CORRECTED_TOPIC]):
            pose = ros_pose(message.value.pose.position, message.value.pose.orientation)
            if pose is not None:
                stamps.append(header_stamp_ns(message.value))
                poses.append(pose.planar()[0])
        topics = choose_topics(recording, TopicArguments())
        found = find_mounting(recording, topics)
        mounting = Mounting(np.zeros(3)) if found is None else Mounting(found.base_from_scan_xyyaw, found.upside_down)
        records = scan_stream(recording, topics, skipped=Counter())
        return key_steps(records, mounting, np.array(stamps), np.array(poses))


def key_steps(
    records: Iterable[LidarScan | WheelPose], mounting: Mounting, stamps_ns: np.ndarray, truth: np.ndarray
) -> KeySteps:
    """Run the front end, without learning; the scans at ``stamps_ns`` ``(n,)`` have the poses ``truth`` ``(n, 3)``."""
    keys: list[tuple[LidarStep, KeyScanStep]] = []
    origin_ns = 0
    for step in _steps(LidarOdometry(mounting=mounting), records):
        origin_ns = step.origin_stamp_ns
        if step.key is not None:
            keys.append((step, step.key))
    if not keys:
        raise RecordingError("the drive has no key scan after its first scan; expected a robot that moves")
    rows = np.searchsorted(stamps_ns, [origin_ns, *(step.stamp_ns for step, _ in keys)])
    return KeySteps(
        truth[rows],
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


def _stamp_ns(stamp_s: float) -> int:
    return _START_NS + round(stamp_s * 1e9)
