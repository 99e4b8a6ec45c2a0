"""A lidar's estimators over the scans and wheels of a recording, as the live nodes compute (no ROS here)."""

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from ngo_estimator.frontend.intake.lidar_intake import LidarIntake, MountingOf, scanner_of
from ngo_estimator.frontend.intake.wheel_clock import WheelTruth
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep, Run, Truth
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.trajectory.files import seconds
from ngo_recordings.scan_stream import ImuReading, LidarScan, WheelPose

LidarRecord = LidarScan | WheelPose | ImuReading

_MOST_WALL_POINTS = 400_000
_LEAST_LAG_S = 0.005  # An age of scans that is said.

_LEARNED_SCANS = 600
_LEARNED_M, _LEARNED_RAD = 6.0, 6.0  # Way and turn after which faults of scanners and wheels are known.

_LOST_SHARE = 0.01  # Of the first scans: with so many that do not say where they were taken, wheels are doubted.

_OTHER_CLOCK_S = 0.15  # Scanners whose ages differ by more are not put together.

_TO_BLAME = 0.5  # Without wheels that are to blame, fewer scans than this share of those get lost.


class LidarRun(Run):
    """Feeds scans and wheel poses through both estimators as the nodes do with messages.

    Args:
        odometry, online: the estimators, which begin anew.
        mounting: where the scanner sits on the robot; or where the scanner of a frame does, for several.
        min_range_m: nearer ranges are not used.
    """

    _online: ScanTrajectory

    def __init__(
        self,
        odometry: MixtureLidar,
        online: ScanTrajectory,
        mounting: Mounting | MountingOf,
        min_range_m: float = 0.0,
    ) -> None:
        mounting_of = (lambda frame: mounting) if isinstance(mounting, Mounting) else mounting
        super().__init__(online, "scan")
        self._odometry = LidarIntake(odometry, mounting_of, min_range_m)
        self.unsure = 0
        """Scans that did not say where they were taken."""

    @property
    def facts(self) -> dict[str, Any]:
        """What else is worth keeping of the run."""
        return {
            "unsure": self.unsure,
            "lag_s": self._odometry.lag_s,
            "mounting_yaw_deg": math.degrees(self._odometry.mounting_yaw_rad),
            **super().facts,
        }

    def remarks(self) -> list[str]:
        """What a person should know of the run, a line each."""
        lines = self._odometry.remarks()
        if abs(lag_s := self._odometry.lag_s) >= _LEAST_LAG_S:
            side = "older" if lag_s > 0.0 else "younger"
            lines.append(f"scans are {abs(lag_s):.2f} s {side} than their stamps, by the wheels' clock: corrected")
        if yaw := math.degrees(self._odometry.mounting_yaw_rad):
            side = "left" if yaw > 0.0 else "right"
            lines.append(
                f"the scanner looks {abs(yaw):.1f} deg further to the {side} than its mounting says, by the wheels' "
                "way, or its angle increment is wrong: not corrected"
            )
        if self.unsure:
            lines.append(f"{self.unsure} scans did not say where they were taken: the motion was predicted there")
        return lines + super().remarks()

    def learn(self, records: Iterable[LidarRecord]) -> WheelTruth:
        """Look at the beginning of a recording for what is to be known of scanners and wheels, before a run.

        Where scans get lost by the wheels, scans alone are asked: where these get lost as well, it was not for the
        wheels. Returns what is wrong with the wheels. Live, it is learned on the way.
        """
        read: list[LidarRecord] = []
        lost, known = self._look_at(records, read), self._odometry.keep_lag()
        if self._leaves_out(read):
            lost, known = self._look_at(read, []), self._odometry.keep_lag()
        if lost > _LOST_SHARE and self._odometry.has_wheels:
            self._odometry.reset()
            self._odometry.judge_wheels(WheelTruth(useless=True))
            alone = self._look_at(read, [])
            doubted = self._odometry.keep_lag()
            if not doubted.useless or alone < _TO_BLAME * lost:
                known = doubted
        self._odometry.judge_wheels(known)
        self._odometry.reset()
        return known

    def _leaves_out(self, read: list[LidarRecord]) -> bool:
        """Leave out scanners whose stamps contradict those of the one that agrees best with the wheels."""
        names, ages = self._odometry.scanners, {}
        if len(names) < 2 or not self._odometry.has_wheels:
            return False
        for name in names:
            self._begin_anew()
            self._look_at([each for each in read if not isinstance(each, LidarScan) or scanner_of(each) == name], [])
            known = self._odometry.keep_lag()
            ages[name] = known.age_s - known.offset_s
        best = min(ages.values(), key=abs)
        self._odometry.left_out = {name: age - best for name, age in ages.items() if abs(age - best) > _OTHER_CLOCK_S}
        self._begin_anew()
        return bool(self._odometry.left_out)

    def _begin_anew(self) -> None:
        self._odometry.reset()
        self._odometry.judge_wheels(WheelTruth())

    def _look_at(self, records: Iterable[LidarRecord], read: list[LidarRecord]) -> float:
        """Go over records until enough is known, and keep what was read; returns the share of scans that got lost."""
        scans, unsure, way_m, turn_rad = 0, 0, 0.0, 0.0
        for record in records:
            read.append(record)
            with suppress(ValueError):
                if isinstance(record, WheelPose):
                    self._odometry.add_wheels(record.stamp_ns, record.pose_xyyaw)
                elif isinstance(record, ImuReading):
                    self._odometry.add_imu(record.stamp_ns, record.rate_rps, record.up)
                else:
                    scans += 1
                    self._odometry.add_scan(record)
                for step in self._odometry.ready():
                    unsure += step.unsure
                    way_m += math.hypot(step.relative_xyyaw[0], step.relative_xyyaw[1])
                    turn_rad += abs(float(step.relative_xyyaw[2]))
            if scans > _LEARNED_SCANS or (way_m > _LEARNED_M and turn_rad > _LEARNED_RAD):
                break
        return unsure / max(scans, 1)

    def run(self, records: Iterable[LidarRecord], truth: Truth | None = None) -> Iterator[RecordedStep | RecordedRun]:
        """Every step, and after the last one of a trajectory the whole of it.

        A recording whose stamps jump back by a second or more holds several trajectories.
        """
        truth = truth or Truth()
        self._odometry.reset()
        self._online.reset()
        for record in records:
            if isinstance(record, WheelPose):
                try:
                    self._odometry.add_wheels(record.stamp_ns, record.pose_xyyaw)
                except ValueError as error:
                    self._reject("wheel pose not usable", f"{seconds(record.stamp_ns)} s: {error}")
            elif isinstance(record, ImuReading):
                self._odometry.add_imu(record.stamp_ns, record.rate_rps, record.up)
            else:
                self.frames += 1
                restarts = self._odometry.restarts
                try:
                    self._odometry.add_scan(record)
                except ValueError as error:
                    self._reject_frame(record.stamp_ns, error)
                if self._odometry.restarts != restarts:
                    yield from self._finished(truth)
            yield from self._steps(at_end=False)
        yield from self._steps(at_end=True)
        yield from self._finished(truth)

    def _steps(self, at_end: bool) -> Iterator[RecordedStep]:
        while True:
            try:
                for step in self._odometry.ready(at_end):
                    taken = self._step(step)
                    self.unsure += step.unsure
                    yield taken
                return
            except ValueError as error:
                self._reject("not usable", str(error))

    def _walls(self) -> np.ndarray | None:
        return self._online.walls(_MOST_WALL_POINTS)
