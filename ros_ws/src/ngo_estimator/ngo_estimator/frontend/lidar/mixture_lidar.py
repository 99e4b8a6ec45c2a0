"""The local estimator of a 2D lidar: scans and wheel odometry in, relative poses and key scans out (no ROS here)."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ngo_estimator.data.relative_step import LARGEST_ODOMETRY, RESTART_AFTER_NS, RelativeStep
from ngo_estimator.frontend.lidar.even_stamps import UsualPeriod
from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig, read_mixture_config
from ngo_estimator.frontend.lidar.mixture_odometry import MixtureOdometry
from ngo_estimator.frontend.lidar.stamped_wheels import StampedWheels
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame, UnusableImage
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import Array, arc_velocity, compose
from ngo_estimator.geometry.scan_points import Mounting, Sweep, key_scan
from ngo_recordings.scan_stream import LidarScan

_FARTHEST_M = 1000.0
"""Stands for a ``range_max`` of zero or infinity, as some drivers publish it."""

_LONGEST_SWEEP_S = 1.0
"""A scan that claims to have taken longer is wrong about it."""

_LEAST_POINTS = 3
"""Points without which a scan says nothing."""

_MOST_RAYS = 20_000
"""A scan with more is refused."""

_WHEEL_WAIT_S = 0.25
"""A scan waits so long for wheels."""

_SILENT_S = 1.0
"""Wheels that were silent for longer are not waited for."""

_LEAST_YAW_RAD = 0.015
"""A smaller yaw of the scanner is noise of the calibration."""

_SWEPT_M, _SWEPT_RAD = 0.005, 0.005
"""Motion until the middle of a sweep that is too small to remove it anew."""


class MixtureLidar:
    """Turns scans into relative poses, with wheel odometry where the robot has it.

    Scans and wheels are each in order of time, and may arrive in any order against each other.
    """

    def __init__(self, config: MixtureConfig | None = None, mounting: Mounting | None = None) -> None:
        self.config = config or MixtureConfig()
        self.mounting = mounting or Mounting(np.zeros(3))
        """Where the sensor sits on the robot; may be set until the first scan comes."""
        self.restarts = 0
        """How often the stamps jumped back by ``RESTART_AFTER_NS`` or more."""
        self.reset()

    @classmethod
    def load(cls, weights: Path, world: str | None = None) -> "MixtureLidar":
        """Begin with the settings in the folder ``weights``; raises ``LidarFileError`` of one clear line."""
        return cls(read_mixture_config(weights, world))

    def reset(self) -> None:
        """Forget everything: the next scan is the new origin of ``odom``."""
        self._core = MixtureOdometry(self.config)
        self._wheels: StampedWheels | None = None
        self._period = UsualPeriod()
        self._waiting: deque[tuple[LidarScan, float]] = deque()  # with the evened stamp (s)
        self._held: list[LidarScan] = []  # that may be a bunch
        self._newest_ns: int | None = None
        self._last_s: float | None = None
        self._even_s = 0.0
        self._twist = np.zeros(3)
        self._robot_odom: Array | None = None

    @property
    def waiting(self) -> int:
        """How many scans wait."""
        return len(self._waiting) + len(self._held)

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
        """How much further to the left the scanner looks than its mounting says, by the wheels that matches calibrated;
        0 until it is known."""
        ahead = self._core.mixture.calibration[0]
        yaw = -math.atan2(ahead[1], ahead[0])
        return yaw if abs(yaw) > _LEAST_YAW_RAD else 0.0

    def add_wheels(self, stamp_ns: int, pose_xyyaw: Array) -> None:
        """Take the wheels' pose ``(3,)`` in their own frame.

        A pose that is not newer than the last one is of no use and is left out.

        Raises:
            ValueError: the pose is not finite, or larger than ``LARGEST_ODOMETRY``. Nothing has changed.
        """
        if pose_xyyaw.shape != (3,) or not (np.abs(pose_xyyaw) <= LARGEST_ODOMETRY).all():
            raise ValueError(f"the wheels' pose is {pose_xyyaw}; expected three numbers up to {LARGEST_ODOMETRY:g}")
        if self._wheels is None or stamp_ns <= self._wheels.newest_ns - RESTART_AFTER_NS:
            self._wheels = StampedWheels()
        self._wheels.add(stamp_ns, pose_xyyaw)

    def add_scan(self, scan: LidarScan) -> None:
        """Take a scan, which ``ready`` hands on once its wheels are known.

        Raises:
            DuplicateFrame, LateFrame: it is not newer than the last one, but not as old as after a restart.
            UnusableImage: it has too many rays.
        """
        if len(scan.ranges) > _MOST_RAYS:
            raise UnusableImage(f"the scan has {len(scan.ranges)} rays; expected at most {_MOST_RAYS}")
        newest = self._newest_ns
        if newest is not None and scan.stamp_ns <= newest:
            if scan.stamp_ns == newest:
                raise DuplicateFrame(f"scan at {scan.stamp_ns} ns came twice")
            if scan.stamp_ns > newest - RESTART_AFTER_NS:
                raise LateFrame(
                    f"scan at {scan.stamp_ns} ns is {(newest - scan.stamp_ns) / 1e9:.3f} s older than the last"
                )
            wheels = self._wheels
            self.reset()
            self.restarts += 1
            newest = None
            if wheels is not None and wheels.newest_ns < scan.stamp_ns + RESTART_AFTER_NS:  # of the new run already
                self._wheels = wheels
        gap_s = 0.0 if newest is None else (scan.stamp_ns - newest) * 1e-9
        bunched = newest is not None and self._period.bunched(gap_s)
        if not bunched:
            self._release()
        if newest is not None:
            self._period.add(gap_s)
        self._newest_ns = scan.stamp_ns
        self._held.append(scan)
        if not bunched and not self._period.late(gap_s):
            self._release()

    def _release(self) -> None:
        """Spread the bunch that came evenly over the time since the scan before it."""
        for number, scan in enumerate(self._held):
            at_s = self._held[-1].stamp_ns * 1e-9
            if self._even_s > 0.0:
                at_s = self._even_s + (number + 1) / len(self._held) * (at_s - self._even_s)
            self._waiting.append((scan, at_s))
        if self._held:
            self._even_s = self._held[-1].stamp_ns * 1e-9
        self._held.clear()

    def ready(self, at_end: bool = False) -> Iterator[RelativeStep]:
        """The steps to all scans whose wheels are known by now; ``at_end`` no more wheels come.

        Raises:
            UnusableImage: a scan has no usable ray. It is gone; call again for the next.
        """
        newest_s = self._wheels.newest_ns * 1e-9 if self._wheels is not None else 0.0
        if self._held and (at_end or newest_s > self._held[-1].stamp_ns * 1e-9 + self._period.period_s / 6.0):
            self._release()
        while self._waiting and (at_end or self._has_wheels(self._waiting[0][1])):
            step = self._step(*self._waiting.popleft())
            if step is not None:
                yield step

    def _has_wheels(self, at_s: float) -> bool:
        if self._wheels is None or self._newest_ns is None:
            return True
        newest_s = self._wheels.newest_ns * 1e-9
        until = at_s - self.lag_s + _duration_s(self._waiting[0][0])
        return (
            newest_s >= until
            or newest_s < min(until, self._last_s or until) - _SILENT_S
            or self._newest_ns * 1e-9 >= at_s + _WHEEL_WAIT_S
        )

    def _step(self, scan: LidarScan, at_s: float) -> RelativeStep | None:
        last_s, wheels, calibration = self._last_s, self._wheels, self._core.mixture.calibration
        if last_s is None:
            self._core.begin(self._key_scan(scan, None if wheels is None else self._sweep(scan, at_s, math.inf)))
            self._last_s = at_s
            return None
        gap_s = at_s - last_s
        by_wheels = None if wheels is None else wheels.motion(last_s, at_s, calibration)
        counted = None if wheels is None else wheels.motion(last_s, at_s, np.eye(3))
        sweep = self._sweep(scan, at_s, gap_s)
        again = None if sweep is None else partial(self._swept_again, scan, sweep, gap_s)
        gap, longest_s = gap_s / max(self._period.period_s, 1e-3), self.config.silent_s
        silent = gap_s > longest_s and gap > self.config.most_gap
        if silent and wheels is not None and by_wheels is not None:
            silent = bool((wheels.gaps(last_s, at_s, longest_s)[1] > longest_s).any())
        step = self._core.update(self._key_scan(scan, sweep), by_wheels, counted, gap, silent, again)
        self._last_s, self._twist = at_s, arc_velocity(step.relative_xyyaw, max(gap_s, 1e-3))
        if wheels is not None and not step.unsure:
            wheels.observe_turn(last_s, at_s, float(step.relative_xyyaw[2]))
        pose = None if wheels is None else wheels.pose_at(at_s)
        if pose is None and self._robot_odom is not None:
            pose = compose(self._robot_odom, step.relative_xyyaw)
        self._robot_odom = pose
        return replace(step, robot_odom_xyyaw=pose)

    def _key_scan(self, scan: LidarScan, sweep: Sweep | None) -> KeyScan:
        largest = scan.range_max if 0.0 < scan.range_max < _FARTHEST_M else _FARTHEST_M
        least = scan.range_min if 0.0 <= scan.range_min < largest else 0.0
        try:
            key = key_scan(
                scan.stamp_ns, scan.angles, scan.ranges, (least, largest), self.mounting, sweep, self.config.points
            )
        except ValueError as error:
            raise UnusableImage(str(error)) from error
        if len(key.points) < _LEAST_POINTS:
            raise UnusableImage(f"the scan has {len(key.points)} usable returns; expected at least {_LEAST_POINTS}")
        return key

    def _sweep(self, scan: LidarScan, at_s: float, gap_s: float) -> Sweep | None:
        """How the robot moves during the scan, where the scan says how long it takes."""
        sweep_s = _duration_s(scan)
        if scan.sweep_s == 0.0 or not 0.0 < sweep_s <= 1.2 * gap_s:
            return None
        offsets_s, twist = scan.ray_offsets_s, self._twist
        first_s, last_s = float(offsets_s.min()), float(offsets_s.max())
        if self._wheels is not None:
            by_wheels = self._wheels.motion(at_s + first_s, at_s + last_s, self._core.mixture.calibration)
            twist = twist if by_wheels is None else arc_velocity(by_wheels, max(last_s - first_s, 1e-3))
        return Sweep(offsets_s, twist)

    def _swept_again(self, scan: LidarScan, sweep: Sweep, gap_s: float, step: Array) -> KeyScan | None:
        """The scan without the motion that a match ``step`` ``(3,)`` tells; None where that is much the same.

        Points that were moved by another velocity lie off by its error until the sweep's middle, and so does the step.
        """
        middle_s = 0.5 * float(sweep.offsets_s.min() + sweep.offsets_s.max())
        twist = (arc_velocity(step, 1.0) + middle_s * sweep.twist) / (gap_s + middle_s)
        off = np.abs(middle_s * (twist - sweep.twist))
        if max(off[0], off[1]) < _SWEPT_M and off[2] < _SWEPT_RAD:
            return None
        return self._key_scan(scan, replace(sweep, twist=twist))


def _duration_s(scan: LidarScan) -> float:
    """How long the sweep lasts (s); 0 where the scan does not say it, or says what cannot be."""
    return scan.sweep_s if scan.sweep_s <= _LONGEST_SWEEP_S else 0.0
