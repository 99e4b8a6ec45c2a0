"""The scans of one scanner as they should be: what its driver says wrongly is noticed, and corrected."""

from dataclasses import replace

from ngo_estimator.frontend.intake.no_return import NoReturnValues
from ngo_estimator.frontend.intake.own_returns import OwnReturns
from ngo_estimator.frontend.intake.range_unit import RangeUnit
from ngo_estimator.frontend.intake.single_scanner import MotionSince, SingleScanner
from ngo_estimator.frontend.intake.sweep import MeasuredSweep
from ngo_estimator.geometry.planar_motion import Array
from ngo_recordings.scan_stream import LidarScan


class Scanner:
    """Corrects scans by what was learned of their scanner."""

    def __init__(self) -> None:
        self.sweep = MeasuredSweep()
        """How long it sweeps and which way."""
        self._single = SingleScanner()
        self._unit = RangeUnit()
        self._no_return = NoReturnValues()
        self._own = OwnReturns()
        self._notes: dict[str, None] = {}  # what its messages say otherwise, each once

    def correct(
        self, scan: LidarScan, min_range_m: float, driven: MotionSince = lambda from_ns: None
    ) -> LidarScan | None:
        """The scan as it should be, without ranges below ``min_range_m``; None where it is the last one again,
        though the robot has ``driven``, or of another scanner."""
        if not self._single.counts(scan, driven):
            return None
        self._notes |= {scan.note: None} if scan.note else {}
        scan = self._unit.metres(scan)
        if scan.range_min < min_range_m:
            scan = replace(scan, range_min=min_range_m)
        scan = self._no_return.clean(scan)
        ranges = self._own.clean(scan)
        if ranges is not scan.ranges:
            scan = replace(scan, ranges=ranges)
        return self.sweep.correct(scan)

    def interrupt(self) -> None:
        """What comes is not compared with what came; what was learned stays."""
        self.sweep.interrupt()
        self._single.interrupt()

    def moved(self, step: Array) -> None:
        """Take the robot's motion ``(3,)`` since the scan before."""
        self._own.moved(step)
        self._no_return.moved(step)

    def remarks(self, name: str) -> list[str]:
        """What is wrong with it, a line each."""
        lines = []
        if self._no_return.values:
            values = ", ".join(f"{value:g}" for value in self._no_return.values)
            lines.append(f"{name} says {values} m where nothing came back: taken so")
        told = *self._notes, self._unit.remark(), *self._single.remarks(), self.sweep.remark()
        lines += [f"{name}: {line}" for line in told if line]
        if self._own.rays:
            lines.append(f"{self._own.rays} rays of {name} see the robot itself: left out")
        return lines
