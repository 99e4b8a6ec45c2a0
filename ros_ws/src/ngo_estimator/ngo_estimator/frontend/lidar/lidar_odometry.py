"""The local estimator of a 2D lidar: scans and wheel odometry in, relative poses and key scans out (no ROS here)."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.data.relative_step import LARGEST_ODOMETRY, RESTART_AFTER_NS, KeyScanStep, RelativeStep
from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.frontend.lidar.scan_odometry import ScanEstimate, ScanOdometry, ScanOdometryConfig
from ngo_estimator.frontend.lidar.standstill import StandstillDetector
from ngo_estimator.frontend.lidar.swept_scan import SweptScan
from ngo_estimator.frontend.lidar.wheel_odometry import WheelOdometry, WheelOdometryConfig
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame, UnusableImage
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import Array, between, compose, turned_covariance
from ngo_estimator.geometry.scan_points import Mounting, ScanPointsConfig, Sweep, key_scan
from ngo_estimator.networks.step_scaling import StepScaling
from ngo_recordings.scan_stream import LidarScan

FRONT_ENDS = ("registration", "mixture")

_FARTHEST_M = 1000.0
"""Stands for a ``range_max`` of zero or infinity, as some drivers publish it."""

_SWEEP_STEPS = 2
"""Steps whose mean velocity removes a sweep's motion.

Of one step alone the error comes back with the other sign, and swings.
"""

_LONGEST_SWEEP_S = 1.0
"""A scan that claims to have taken longer is wrong about it."""

_LEAST_POINTS = 3
"""Points without which a scan says nothing."""


@dataclass(frozen=True)
class LidarOdometryConfig:
    """How scans and wheels become odometry.

    A scan waits for wheels at most ``wheel_wait_s``. Wheels that were silent for ``wheel_silence_s`` are not waited
    for. A scan with more than ``most_rays`` rays is refused. ``least_variance_m2`` and ``least_variance_rad2`` are
    the smallest variances of a step. With ``learned_deviation`` a trained network scales the deviations that are
    published; no pose changes. ``front_end`` is ``registration``, which is this one, or ``mixture``, which has its own
    settings.
    """

    points: ScanPointsConfig = field(default_factory=ScanPointsConfig)
    odometry: ScanOdometryConfig = field(default_factory=ScanOdometryConfig)
    wheels: WheelOdometryConfig = field(default_factory=WheelOdometryConfig)
    wheel_wait_s: float = 0.25
    wheel_silence_s: float = 1.0
    most_rays: int = 20_000
    least_variance_m2: float = 1e-8
    least_variance_rad2: float = 1e-9
    learned_deviation: bool = False
    front_end: str = "registration"
    mixture: MixtureConfig = field(default_factory=MixtureConfig)

    def __post_init__(self) -> None:
        if self.front_end not in FRONT_ENDS:
            raise ValueError(f"front_end is {self.front_end!r}; expected one of {FRONT_ENDS}")
        positive = (self.wheel_wait_s, self.wheel_silence_s, self.least_variance_m2, self.least_variance_rad2)
        if not all(0.0 < value < math.inf for value in positive) or self.most_rays < 2:
            raise ValueError(
                f"wheel_wait_s, wheel_silence_s, least_variance_m2, least_variance_rad2 are {positive} and most_rays "
                f"is {self.most_rays}; expected positive numbers, and at least 2 rays"
            )


@dataclass(frozen=True, eq=False)
class LidarStep(RelativeStep):
    """Motion between two scans.

    ``share`` of the points fit the walls seen before. The scan of an ``unsure`` step does not say where it was taken.
    ``evidence`` ``(12,)`` has the columns ``STEP_EVIDENCE``.
    """

    share: float
    unsure: bool
    evidence: Array


class LidarOdometry:
    """Turns scans into relative poses, with wheel odometry where the robot has it.

    Scans and wheels are each in order of time, and may arrive in any order against each other.
    """

    def __init__(
        self,
        config: LidarOdometryConfig | None = None,
        mounting: Mounting | None = None,
        scaling: StepScaling | None = None,
    ) -> None:
        self.config = config or LidarOdometryConfig()
        if self.config.learned_deviation != (scaling is not None):
            raise ValueError(
                f"learned_deviation is {self.config.learned_deviation}, and the network is {scaling}; expected both "
                "or neither"
            )
        self._scaling = scaling
        self.mounting = mounting or Mounting(np.zeros(3))
        """Where the sensor sits on the robot; may be set until the first scan comes."""
        self.restarts = 0
        """How often the stamps jumped back by ``RESTART_AFTER_NS`` or more."""
        self.reset()

    @classmethod
    def load(cls, weights: Path, world: str | None = None) -> "LidarOdometry":
        """Begin with the settings in the folder ``weights``, and the trained network where they ask for it.

        Raises:
            LidarFileError, CheckpointError: of one clear line.
        """
        config = read_lidar_file(weights, "odometry", LidarOdometryConfig, world)
        return cls(config, scaling=StepScaling.load(weights, world) if config.learned_deviation else None)

    def reset(self) -> None:
        """Forget everything: the next scan is the new origin of ``odom``."""
        self._core = ScanOdometry(self.config.odometry, self._scaling)
        self._standstill = StandstillDetector()
        self._wheels: WheelOdometry | None = None
        self._newest_wheels_ns: int | None = None
        self._waiting: deque[LidarScan] = deque()
        self._last: KeyScan | None = None
        self._last_steps: deque[tuple[float, Array]] = deque(maxlen=_SWEEP_STEPS)
        self._origin: KeyScan | None = None
        self._robot_odom: Array | None = None
        self._key_ns = 0
        self._key_doubt = self._last_doubt = np.zeros((3, 3))
        self._origin_ns = 0

    @property
    def waiting(self) -> int:
        """How many scans wait for the wheels."""
        return len(self._waiting)

    @property
    def has_wheels(self) -> bool:
        """Whether wheel odometry came since the start."""
        return self._wheels is not None

    @property
    def lag_s(self) -> float:
        """How much older the scans are than their stamps (s), by the wheels' clock; 0 until it is known."""
        return 0.0 if self._wheels is None else self._wheels.lag_s

    @property
    def mounting_yaw_rad(self) -> float:
        """How much further to the left the scanner looks than its mounting says, by the wheels; 0 until it is known."""
        return 0.0 if self._wheels is None else self._wheels.mounting_yaw.yaw_rad

    def add_wheels(self, stamp_ns: int, pose_xyyaw: Array) -> None:
        """Take the wheels' pose ``(3,)`` in their own frame.

        A pose that is not newer than the last one is of no use and is left out.

        Raises:
            ValueError: the pose is not finite, or larger than ``LARGEST_ODOMETRY``. Nothing has changed.
        """
        if pose_xyyaw.shape != (3,) or not (np.abs(pose_xyyaw) <= LARGEST_ODOMETRY).all():
            raise ValueError(f"the wheels' pose is {pose_xyyaw}; expected three numbers up to {LARGEST_ODOMETRY:g}")
        newest = self._newest_wheels_ns
        if newest is not None and stamp_ns <= newest - RESTART_AFTER_NS:
            self._wheels, self._newest_wheels_ns = None, None
        if self._wheels is None:
            self._wheels = WheelOdometry(self.config.wheels)
        self._wheels.add(stamp_ns, pose_xyyaw)
        self._newest_wheels_ns = max(stamp_ns, self._newest_wheels_ns or stamp_ns)

    def add_scan(self, scan: LidarScan) -> None:
        """Take a scan, which ``ready`` hands on once its wheels are known.

        Raises:
            DuplicateFrame, LateFrame: it is not newer than the last one, but not as old as after a restart.
            UnusableImage: it has too many rays.
        """
        if len(scan.ranges) > self.config.most_rays:
            raise UnusableImage(f"the scan has {len(scan.ranges)} rays; expected at most {self.config.most_rays}")
        newest = self._waiting[-1].stamp_ns if self._waiting else None if self._last is None else self._last.stamp_ns
        if newest is not None and scan.stamp_ns <= newest:
            if scan.stamp_ns == newest:
                raise DuplicateFrame(f"scan at {scan.stamp_ns} ns came twice")
            if scan.stamp_ns > newest - RESTART_AFTER_NS:
                raise LateFrame(
                    f"scan at {scan.stamp_ns} ns is {(newest - scan.stamp_ns) / 1e9:.3f} s older than the last"
                )
            wheels, stamp_ns = self._wheels, self._newest_wheels_ns
            self.reset()
            self.restarts += 1
            if stamp_ns is not None and stamp_ns < scan.stamp_ns + RESTART_AFTER_NS:  # of the new run already
                self._wheels, self._newest_wheels_ns = wheels, stamp_ns
        self._waiting.append(scan)

    def ready(self, at_end: bool = False) -> Iterator[LidarStep]:
        """The steps to all scans whose wheels are known by now; ``at_end`` no more wheels come.

        Raises:
            UnusableImage: a scan has no usable ray. It is gone; call again for the next.
        """
        while self._waiting and (at_end or self._has_wheels(self._waiting[0].stamp_ns)):
            step = self._step(self._waiting.popleft())
            if step is not None:
                yield step

    def _has_wheels(self, stamp_ns: int) -> bool:
        if self._wheels is None or self._newest_wheels_ns is None:
            return True
        until = stamp_ns + int((_duration_s(self._waiting[0]) - self.lag_s) * 1e9)
        newest_scan_ns = self._waiting[-1].stamp_ns
        # Where the scans paused, the wheels may have paused with them.
        heard_until = until if self._last is None else min(until, self._last.stamp_ns)
        return (
            self._newest_wheels_ns >= until
            or self._newest_wheels_ns < heard_until - int(self.config.wheel_silence_s * 1e9)
            or newest_scan_ns >= stamp_ns + int(self.config.wheel_wait_s * 1e9)
        )

    def _step(self, scan: LidarScan) -> LidarStep | None:
        sweep = self._sweep(scan)
        swept = self._swept(scan, sweep)
        if len(swept.scan.points) < _LEAST_POINTS:
            raise UnusableImage(
                f"the scan has {len(swept.scan.points)} usable returns; expected at least {_LEAST_POINTS}"
            )
        last = self._last
        again = None if self._wheels is None or sweep is None else partial(self._swept_otherwise, scan, sweep)
        estimate = self._core.update(swept, self._wheels, again, self._standstill.stands(scan))
        key = estimate.swept.scan
        self._last = key
        if last is None:
            self._origin, self._origin_ns, self._key_ns = key, key.stamp_ns, key.stamp_ns
            return None
        elapsed_s = (key.stamp_ns - last.stamp_ns) * 1e-9
        self._last_steps.append((elapsed_s, estimate.step))
        doubt = estimate.sweep_doubt
        if sweep is not None and (self._wheels is None or estimate.swept is not swept):
            # Its points were moved by another motion than the robot turned out to have: by half of it on the mean.
            off = estimate.swept.off(estimate.step / elapsed_s)
            doubt = doubt + np.outer(off, off)
        return self._published(key, last, estimate, doubt)

    def _published(self, key: KeyScan, last: KeyScan, estimate: ScanEstimate, doubt: Array) -> LidarStep:
        """The step; ``doubt`` ``(3, 3)`` is the covariance that the sweep's motion adds to the scan's pose, along the
        robot's axes."""
        least = np.diag((self.config.least_variance_m2, self.config.least_variance_m2, self.config.least_variance_rad2))
        both = self._last_doubt + turned_covariance(estimate.step[2], doubt)
        self._last_doubt = doubt
        key_step = None
        if estimate.is_key:
            own = estimate.since_key_covariance + least
            more = self._key_doubt + turned_covariance(estimate.since_key[2], doubt)
            # The network that gave the factors knows nothing of sweeps.
            scaled = own.diagonal() * estimate.factors**2 + more.diagonal()
            factors = np.sqrt(scaled / (own + more).diagonal())
            key_step = KeyScanStep(key, self._key_ns, estimate.since_key, own + more, factors)
            self._key_ns, self._key_doubt = key.stamp_ns, doubt
        origin, self._origin = self._origin, None
        nothing = np.zeros(0, np.float32)
        return LidarStep(
            stamp_ns=key.stamp_ns,
            from_stamp_ns=last.stamp_ns,
            relative_xyyaw=estimate.step,
            covariance=estimate.step_covariance + least + both,
            origin_stamp_ns=self._origin_ns,
            odom_xyyaw=estimate.pose,
            motion_feature=nothing,
            place_code=nothing,
            share=estimate.share,
            unsure=estimate.unsure,
            evidence=estimate.evidence,
            key=key_step,
            origin_scan=origin,
            robot_odom_xyyaw=self._robot_odom_at(key.stamp_ns, estimate.step),
        )

    def _robot_odom_at(self, stamp_ns: int, step: Array) -> Array | None:
        """Pose of the newest scan in the wheels' frame; by our own step while the wheels are silent."""
        pose = None if self._wheels is None else self._wheels.pose_at(stamp_ns)
        if pose is None and self._robot_odom is not None:
            pose = compose(self._robot_odom, step)
        self._robot_odom = pose
        return pose

    def _swept(self, scan: LidarScan, sweep: Sweep | None) -> SweptScan:
        key = self._key_scan(scan, sweep)
        return SweptScan(key) if sweep is None else SweptScan(key, float(sweep.offsets_s.mean()), sweep.twist)

    def _swept_otherwise(self, scan: LidarScan, sweep: Sweep, twist: Array) -> SweptScan:
        return self._swept(scan, replace(sweep, twist=twist))

    def _key_scan(self, scan: LidarScan, sweep: Sweep | None) -> KeyScan:
        largest = scan.range_max if 0.0 < scan.range_max < _FARTHEST_M else _FARTHEST_M
        least = scan.range_min if 0.0 <= scan.range_min < largest else 0.0
        try:
            return key_scan(
                scan.stamp_ns,
                scan.angles,
                scan.ranges,
                (least, largest),
                self.mounting,
                sweep,
                self.config.points,
            )
        except ValueError as error:
            raise UnusableImage(str(error)) from error

    def _sweep(self, scan: LidarScan) -> Sweep | None:
        """How the robot moves during the scan, where the scan says how long it takes and the motion is known."""
        if self._last is None or not self._last_steps or scan.sweep_s == 0.0:
            return None
        between_s, sweep_s = (scan.stamp_ns - self._last.stamp_ns) * 1e-9, _duration_s(scan)
        # A sweep that lasts longer than from scan to scan is none.
        if not 0.0 < sweep_s <= 1.2 * between_s:
            return None
        duration_s = sum(duration for duration, _ in self._last_steps)
        twist = np.sum([step for _, step in self._last_steps], axis=0) / duration_s
        if self._wheels is not None:
            end_ns = scan.stamp_ns + int(sweep_s * 1e9)
            ends = self._wheels.pose_at(scan.stamp_ns), self._wheels.pose_at(end_ns)
            froze = self._wheels.frozen_s(scan.stamp_ns) > 0.0 or self._wheels.frozen_s(end_ns) > 0.0
            if not froze and ends[0] is not None and ends[1] is not None:
                twist = between(ends[0], ends[1]) / sweep_s
        return Sweep(scan.ray_offsets_s, twist)


def _duration_s(scan: LidarScan) -> float:
    """How long the sweep lasts (s); 0 where the scan does not say it, or says what cannot be."""
    return scan.sweep_s if scan.sweep_s <= _LONGEST_SWEEP_S else 0.0
