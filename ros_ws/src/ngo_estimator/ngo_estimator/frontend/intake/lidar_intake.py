"""What stands before the front end of a lidar: scans as they should be, of all scanners together (no ROS here)."""

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ngo_estimator.data.relative_step import LARGEST_ODOMETRY, RelativeStep
from ngo_estimator.frontend.intake.floor_rays import FloorRays
from ngo_estimator.frontend.intake.imu_turns import ImuTurns
from ngo_estimator.frontend.intake.scanner import Scanner
from ngo_estimator.frontend.intake.single_wheels import SingleWheels
from ngo_estimator.frontend.intake.stray_stamps import StrayStamps
from ngo_estimator.frontend.intake.turns import Part, Turns
from ngo_estimator.frontend.intake.wheel_clock import CorrectedWheels, WheelClock, WheelTruth
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import Array
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose

_NEWS_STEPS = 20
"""Steps after which there may be news."""

_OTHER_WAY, _OTHER_WAY_M = 0.5, 0.03
"""Ways that are apart by more than this share of the longer one, and by so much, are not the same."""

MountingOf = Callable[[str], Mounting | None]
"""Where the scanner of a frame sits; None where it is not known."""


class LidarIntake:
    """Hands scans and wheels to a front end, whose methods it has.

    Scans of several scanners, and sectors of one, come as one scan of the first scanner. Ranges that are no returns, or
    see the robot itself, are left out.

    Args:
        front_end: begins anew.
        mounting_of: asked once for each frame. A scanner whose mounting is not known is left out beside others.
        min_range_m: nearer ranges are not used.
    """

    def __init__(self, front_end: MixtureLidar, mounting_of: MountingOf, min_range_m: float = 0.0) -> None:
        self.front_end, self._mounting_of, self._min_range_m = front_end, mounting_of, min_range_m
        self._scanners: dict[str, Scanner] = {}
        self.left_out: dict[str, float] = {}
        """Scanners that are not used, and how much older their scans are than those of the others (s)."""
        self._clock = WheelClock()
        self._imu = ImuTurns()
        self._floor = FloorRays()
        self.reset()

    def reset(self) -> None:
        """Begin anew: the next scan is the new origin of ``odom``. What was learned of the scanners stays."""
        self.front_end.reset()
        self._turns = Turns()
        self._stray_scans: StrayStamps[LidarScan] = StrayStamps()
        self._stray_wheels: StrayStamps[WheelPose] = StrayStamps()
        self._single_wheels = SingleWheels()
        self._mountings: dict[str, Mounting | None] = {}
        for scanner in self._scanners.values():
            scanner.interrupt()
        self._imu.interrupt()
        self._wheels = CorrectedWheels(self._imu)
        self._waiting_wheels: deque[WheelPose] = deque()
        clock = WheelClock()
        clock.truth = self._clock.truth
        self._clock = clock
        self._steps = 0
        self._said: set[str] = set()

    @property
    def waiting(self) -> int:
        """How many scans wait."""
        return self.front_end.waiting + self._turns.waiting

    @property
    def has_wheels(self) -> bool:
        """Whether wheel odometry came since the start."""
        return self.front_end.has_wheels

    @property
    def scanners(self) -> list[str]:
        """The scanners that were heard and whose mounting is known."""
        return [name for name in self._scanners if self._mountings.get(name) is not None]

    @property
    def lag_s(self) -> float:
        """How much older the scans are than their stamps (s), by the wheels' clock; 0 until it is known."""
        return self.front_end.lag_s + self._clock.truth.age_s

    @property
    def mounting_yaw_rad(self) -> float:
        """How much further to the left the scanner looks than its mounting says, by the wheels; 0 until it is known."""
        return self.front_end.mounting_yaw_rad

    @property
    def restarts(self) -> int:
        """How often the stamps jumped back."""
        return self.front_end.restarts

    def add_wheels(self, stamp_ns: int, pose_xyyaw: Array) -> None:
        """Take the wheels' pose ``(3,)``; raises ``ValueError`` as the front end does."""
        if pose_xyyaw.shape != (3,) or not (np.abs(pose_xyyaw) <= LARGEST_ODOMETRY).all():
            raise ValueError(f"the wheels' pose is {pose_xyyaw}; expected three numbers up to {LARGEST_ODOMETRY:g}")
        for each in self._stray_wheels.add(WheelPose(stamp_ns, pose_xyyaw)):
            for wheels in self._single_wheels.add(each):
                self._clock.add_wheels(wheels.stamp_ns, wheels.pose_xyyaw)
                self._waiting_wheels.append(wheels)
        self._hand_on_wheels()

    def add_imu(self, stamp_ns: int, yaw_rate_rps: float, up: Array | None = None) -> None:
        """Take an IMU's yaw rate about the robot's z, and the world's up in the robot's axes ``(3,)`` where it knows
        it."""
        self._imu.add(stamp_ns, yaw_rate_rps)
        if up is not None:
            self._floor.add(stamp_ns, up)
        self._hand_on_wheels()

    def _hand_on_wheels(self, at_end: bool = False) -> None:
        """Give the front end the wheels whose turn the IMU knows by now."""
        offset_ns = round(self._clock.truth.offset_s * 1e9)
        while self._waiting_wheels:
            wheels = self._waiting_wheels[0]
            if self._imu.used and not at_end and not self._imu.reached(wheels.stamp_ns - offset_ns):
                return
            self._waiting_wheels.popleft()
            at_ns, pose = self._wheels.add(wheels.stamp_ns, wheels.pose_xyyaw, self._clock.truth)
            if not (self._clock.truth.useless or self._wheels.frozen):
                self.front_end.add_wheels(at_ns, pose)

    def add_scan(self, scan: LidarScan) -> None:
        """Take a scan of any scanner; raises ``ValueError`` as the front end does."""
        for each in self._stray_scans.add(scan):
            self._take(each)

    def _take(self, scan: LidarScan) -> None:
        scanner = scanner_of(scan)
        if scanner in self.left_out:
            return
        if scanner not in self._mountings:
            self._meet(scanner, scan.frame_id)
        mounting = self._mountings[scanner]
        if mounting is None:
            return
        corrected = self._scanners[scanner].correct(scan, self._min_range_m, self._wheels.since)
        if corrected is not None:
            corrected = self._floor.without(corrected, mounting)
            self._hand_on(self._turns.add(Part(corrected, mounting, scanner)))

    def remount(self) -> None:
        """Ask anew where all scanners sit."""
        self._mountings.clear()
        self._turns = Turns()

    def _hand_on(self, turns: list[LidarScan]) -> None:
        refused: ValueError | None = None
        for turn in turns:
            try:
                self.front_end.add_scan(turn)
            except ValueError as error:
                refused = error
        if refused is not None:
            raise refused

    def _meet(self, scanner: str, frame: str) -> None:
        mounting = self._mounting_of(frame)
        if not any(self._mountings.values()):  # the first one, whose scans are of no use without a place
            mounting = mounting or self.front_end.mounting
            self.front_end.mounting = mounting
        self._mountings[scanner] = mounting
        self._scanners.setdefault(scanner, Scanner())

    def ready(self, at_end: bool = False) -> Iterator[RelativeStep]:
        """The steps to all scans whose wheels are known by now; ``at_end`` nothing more comes.

        Raises:
            UnusableImage: a scan has no usable ray. It is gone; call again for the next.
        """
        if at_end:
            self._hand_on_wheels(at_end)
            for scan in self._stray_scans.flush():
                self._take(scan)
            self._hand_on(self._turns.flush())
        for step in self.front_end.ready(at_end):
            self._steps += 1
            self._observe(step)
            said = self._wheels.said(step.stamp_ns - round(self.front_end.lag_s * 1e9))
            yield step if said is None else replace(step, robot_odom_xyyaw=said)

    def _observe(self, step: RelativeStep) -> None:
        for scanner in self._scanners.values():
            scanner.moved(step.relative_xyyaw)
        if not step.unsure:
            self._wheels.moved(step.relative_xyyaw, step.covariance)
        late_ns = round(self.front_end.lag_s * 1e9)
        motion = self._wheels.motion(step.from_stamp_ns - late_ns, step.stamp_ns - late_ns)
        elapsed_s = (step.stamp_ns - step.from_stamp_ns) * 1e-9
        counted = self._wheels.turn(step.from_stamp_ns - late_ns, step.stamp_ns - late_ns)
        if counted is not None and not step.unsure:
            early_ns = late_ns + round(self._clock.truth.age_s * 1e9)
            begin_ns, end_ns = step.from_stamp_ns - early_ns, step.stamp_ns - early_ns
            by_wheels = counted * self._clock.truth.turn_scale
            self._imu.observe(begin_ns, end_ns, float(step.relative_xyyaw[2]), by_wheels)
        motion = None if self._clock.truth.useless or _contradicts(motion, step.relative_xyyaw) else motion
        for name, scanner in self._scanners.items():
            if self._turns.alone and (mounting := self._mountings.get(name)) is not None:
                scanner.sweep.observe(step.stamp_ns, step.relative_xyyaw, motion, elapsed_s, mounting)
        if not step.unsure and self._clock.add_step(step.from_stamp_ns, step.stamp_ns, step.relative_xyyaw):
            for scanner in self._scanners.values():
                scanner.sweep.forget()
            for stamp_ns, pose in self._wheels.again(self._clock.truth):
                if not self._clock.truth.useless:
                    self.front_end.add_wheels(stamp_ns, pose)

    def judge_wheels(self, truth: WheelTruth) -> None:
        """Take this of the wheels until the scans say more; useless ones until the scans say the same as they do."""
        self._clock.truth = truth

    def keep_lag(self) -> WheelTruth:
        """Take the age of scans that is known by now for what comes after a reset; returns all of the wheels."""
        self._clock.truth = replace(self._clock.truth, age_s=self.lag_s)
        return self._clock.truth

    def remarks(self) -> list[str]:
        """What a person should know of the scans and wheels, a line each."""
        lines = self.problems()
        lines += [line for name, scanner in self._scanners.items() for line in scanner.remarks(name)]
        lines += self._clock.truth.remarks()
        lines += ["the wheels' pose stays while the robot drives: left out meanwhile"] if self._wheels.froze else []
        lines += [line for told in (self._single_wheels, self._imu, self._floor) if (line := told.remark())]
        for name, stray in (("scans", self._stray_scans), ("wheels", self._stray_wheels)):
            if stray.left_out:
                lines.append(f"{stray.left_out} of the {name} are stamped far from those before and after: left out")
        return lines

    def news(self) -> list[str]:
        """The remarks that are new since the last call, each once whatever its numbers."""
        if self._steps % _NEWS_STEPS:
            return []
        fresh = {_words(line): line for line in self.remarks() if _words(line) not in self._said}
        self._said |= fresh.keys()
        return list(fresh.values())

    def problems(self) -> list[str]:
        """A line for each scanner that is missing or left out."""
        lines = [f"{name} is left out: its mounting is not known" for name, at in self._mountings.items() if at is None]
        lines += [
            f"{name} is left out: its scans are {abs(age_s):.2f} s {'older' if age_s > 0.0 else 'younger'} than those "
            "of the others at the same stamps, by the wheels"
            for name, age_s in self.left_out.items()
        ]
        return [*lines, *(f"nothing more comes from {name}" for name in self._turns.silent())]


def scanner_of(scan: LidarScan) -> str:
    """The name of the scanner that a scan is from."""
    return f"{scan.topic} {scan.frame_id}".strip()


def _contradicts(motion: Array | None, step: Array) -> bool:
    """Whether the motion ``(3,)`` by the wheels is another one than that by the scans, whatever their sweep."""
    if motion is None:
        return False
    way = max(math.hypot(motion[0], motion[1]), math.hypot(step[0], step[1]))
    return math.hypot(motion[0] - step[0], motion[1] - step[1]) > max(_OTHER_WAY * way, _OTHER_WAY_M)


def _words(line: str) -> str:
    return " ".join(part for part in line.split() if not part[0].isdigit())
