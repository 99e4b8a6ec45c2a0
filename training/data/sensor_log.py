"""A lidar's drive as arrays that may be changed: what an estimator is given, and beside it what it must not see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ngo_estimator.geometry.planar_motion import all_between, chained
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from training.data.lidar_drives import LidarDrive, Reference, TruePoses

FAR_AWAY_M = 10_000.0  # From one place to the next in the truth of drives that were put together.


@dataclass(frozen=True, eq=False)
class SensorLog:
    """What a robot with one scanner measured, scans and wheel poses each in order of time.

    Attributes:
        stamps_ns: of the scans as they are given ``(scans,)``.
        taken_ns: when the scans were really taken ``(scans,)``.
        ranges: m, float32 ``(scans, rays)``.
        wheel_stamps_ns: of the wheel poses as they are given ``(poses,)``.
        wheel_poses: in the wheels' own frame ``(poses, 3)``.
        mounting: where the scanner sits, as it is given.
        scanner: one of the scans, for its angles and limits.
        true_poses: of the robot at each scan ``(scans, 3)``, where they are known.
    """

    stamps_ns: np.ndarray
    taken_ns: np.ndarray
    ranges: np.ndarray
    wheel_stamps_ns: np.ndarray
    wheel_poses: np.ndarray
    mounting: Mounting
    scanner: LidarScan
    true_poses: np.ndarray | None = None

    @classmethod
    def of_drive(cls, drive: LidarDrive) -> SensorLog:
        """The drive as it is; scans and wheel poses that are no newer than one before are left out.

        Raises:
            ValueError: it has no scans, or their rays differ, or the truth is not that of its scans.
        """
        if len({_geometry(scan) for scan in drive.scans}) != 1:
            raise ValueError(f"{drive.name} has {len(drive.scans)} scans; expected scans, all with the same rays")
        stamps_ns, true_poses = drive.scan_stamps_ns, None
        if isinstance(drive.reference, TruePoses):
            if not np.array_equal(drive.reference.stamps_ns, stamps_ns):
                raise ValueError(f"the truth of {drive.name} has other stamps than its scans; expected the same")
            true_poses = drive.reference.poses_xyyaw
        log = cls(
            stamps_ns,
            stamps_ns,
            np.stack([scan.ranges for scan in drive.scans]),
            np.array([pose.stamp_ns for pose in drive.wheels], dtype=np.int64),
            np.array([pose.pose_xyyaw for pose in drive.wheels]).reshape(-1, 3),
            drive.mounting,
            drive.scans[0],
            true_poses,
        )
        return log.in_order()

    def drive(self, name: str, identity: str, relations: Reference | None = None) -> LidarDrive:
        """What an estimator is given, with the truth at the stamps as given, or else with other ``relations``."""
        reference = relations if self.true_poses is None else TruePoses(self.stamps_ns, self.true_poses)
        stamps = self.stamps_ns.tolist(), self.wheel_stamps_ns.tolist()
        scans = (replace(self.scanner, stamp_ns=t, ranges=row) for t, row in zip(stamps[0], self.ranges, strict=True))
        wheels = map(WheelPose, stamps[1], self.wheel_poses)
        return LidarDrive(name, identity, tuple(scans), tuple(wheels), self.mounting, reference)

    def keep_scans(self, kept: np.ndarray) -> SensorLog:
        """The log with some of its scans alone, by a mask ``(scans,)``."""
        truth = None if self.true_poses is None else self.true_poses[kept]
        return replace(
            self,
            stamps_ns=self.stamps_ns[kept],
            taken_ns=self.taken_ns[kept],
            ranges=self.ranges[kept],
            true_poses=truth,
        )

    def keep_wheels(self, kept: np.ndarray) -> SensorLog:
        """The log with some of its wheel poses alone, by a mask ``(poses,)``."""
        return replace(self, wheel_stamps_ns=self.wheel_stamps_ns[kept], wheel_poses=self.wheel_poses[kept])

    @property
    def wheel_steps(self) -> np.ndarray:
        """Each wheel pose seen from the one before ``(poses - 1, 3)``."""
        return np.asarray(all_between(self.wheel_poses[:-1], self.wheel_poses[1:]))

    def with_wheel_steps(self, steps: np.ndarray) -> SensorLog:
        """The log whose wheels go other steps ``(poses - 1, 3)`` from their first pose on."""
        return replace(self, wheel_poses=chained(np.concatenate((self.wheel_poses[:1], steps)))[1:])

    def followed_by(self, other: SensorLog, pause_s: float, away_m: float = FAR_AWAY_M) -> SensorLog:
        """Both logs as one drive whose wheels go on where they were, as if the robot had been carried.

        In the truth the other place lies ``away_m`` from the first; 0 where both are drives through one place. Mounting
        and scanner are those of the first.
        """
        later_ns = int(self.stamps_ns[-1] - other.stamps_ns[0] + pause_s * 1e9)
        truth = None
        if self.true_poses is not None and other.true_poses is not None:
            truth = np.concatenate((self.true_poses, other.true_poses + (away_m, 0.0, 0.0)))
        both = replace(
            self,
            stamps_ns=np.concatenate((self.stamps_ns, other.stamps_ns + later_ns)),
            taken_ns=np.concatenate((self.taken_ns, other.taken_ns + later_ns)),
            ranges=np.concatenate((self.ranges, other.ranges)),
            wheel_stamps_ns=np.concatenate((self.wheel_stamps_ns, other.wheel_stamps_ns + later_ns)),
            wheel_poses=np.concatenate((self.wheel_poses, other.wheel_poses)),
            true_poses=truth,
        )
        steps = np.concatenate((self.wheel_steps, np.zeros((1, 3)), other.wheel_steps))
        return both.with_wheel_steps(steps).in_order()

    @property
    def returned(self) -> np.ndarray:
        """Which rays came back, bool ``(scans, rays)``."""
        largest = self.scanner.range_max if self.scanner.range_max > 0.0 else np.inf
        with np.errstate(invalid="ignore"):
            return np.asarray((self.ranges > max(self.scanner.range_min, 0.0)) & (self.ranges < largest))

    def in_order(self) -> SensorLog:
        """Scans and wheel poses by their stamps as given; what is no newer than one before is left out."""
        return self.keep_scans(_newer(self.stamps_ns)).keep_wheels(_newer(self.wheel_stamps_ns))


def _geometry(scan: LidarScan) -> tuple[float, ...]:
    return (len(scan.ranges), scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max, scan.time_increment)


def _newer(stamps_ns: np.ndarray) -> np.ndarray:
    newest = np.maximum.accumulate(stamps_ns)
    return np.concatenate((np.ones(len(stamps_ns[:1]), bool), np.diff(newest) > 0))
