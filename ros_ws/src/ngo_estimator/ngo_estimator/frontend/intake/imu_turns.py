"""The robot's turns by an IMU, which stand in for those of the wheels where they agree better with the scans.

A gyroscope knows nothing of slipping wheels. Its bias is what it says beyond the scans, its stamps are late by the time
at which it agrees best, and its unit, rad/s or degrees/s, is the one in which it does. A gyroscope that is wrong, of
the wrong sign or in a wrong frame agrees less with the scans than wheels do, and is not used.
"""

import math
from bisect import bisect_left
from collections import deque

import numpy as np

from ngo_estimator.geometry.planar_motion import wrap

_LONGEST_NS = 200_000_000
"""Between two readings whose rates are summed up; at a longer gap the sum begins anew."""

_FASTEST_RPS = 20.0
_KEPT = 4096

_REMEMBERED = 0.995
"""What a step between two scans counts after the next one."""

_LEAST_STEPS = 40.0
_LEAST_TURN_RAD = 1.0
"""Steps, and turn by the scans, that both were compared over before the IMU counts."""

_LARGEST_RAD = 0.1
"""A larger difference counts as this."""

_LATE_NS = np.arange(-500_000_000, 500_000_001, 50_000_000)
_UNITS = np.array((1.0, math.radians(1.0)))
"""Rad/s, and degrees/s."""

_LATEST_NS = 150_000_000
"""How late stamps may be: what is compared, and what is not too late for the scans that wait for it."""

_BETTER = 0.5
"""Share of the wheels' squared differences below which the IMU is used; it stays in use up to the whole."""


class ImuTurns:
    """Sums up yaw rates in bounded memory, and compares the turns between scans."""

    def __init__(self) -> None:
        self.used = False
        """Whether the IMU's turns stand in for the wheels'."""
        self._heard = False
        self._stamps: list[int] = []
        self._sums: list[float] = []  # rad, from the first stamp on
        self._rate = 0.0
        self._steps: deque[tuple[int, int, float, float]] = deque(maxlen=_KEPT)  # from, to, by scans, by wheels
        self._time_s = self._count = self._turned = self._wheels_off = 0.0
        self._ahead, self._off = np.zeros((2, len(_UNITS), len(_LATE_NS)))

    def interrupt(self) -> None:
        """Forget the readings; what was learned of the IMU stays."""
        self._stamps.clear()
        self._sums.clear()
        self._steps.clear()

    @property
    def late_ns(self) -> int:
        """How late its stamps are."""
        return int(_LATE_NS[self._off.argmin() % len(_LATE_NS)]) if self._count >= _LEAST_STEPS else 0

    @property
    def unit(self) -> float:
        """What its readings must be multiplied by."""
        return float(_UNITS[self._off.argmin() // len(_LATE_NS)]) if self._count >= _LEAST_STEPS else 1.0

    @property
    def bias_rps(self) -> float:
        """What it says while the robot does not turn (rad/s)."""
        return float(self._ahead.flat[self._off.argmin()] / self._time_s) if self._time_s > 0.0 else 0.0

    def add(self, stamp_ns: int, rate_rps: float) -> None:
        """Take a yaw rate about the robot's z; one that is no number, or not newer than the last, is left out."""
        if not abs(rate_rps) <= _FASTEST_RPS / (self.unit if self._count >= _LEAST_STEPS else _UNITS[-1]):
            return
        self._heard = True
        gap_ns = stamp_ns - self._stamps[-1] if self._stamps else 0
        if self._stamps and not 0 < gap_ns <= _LONGEST_NS:
            if -_LONGEST_NS < gap_ns <= 0:
                return
            self._stamps.clear()
            self._sums.clear()
        before = self._sums[-1] if self._sums else 0.0
        self._sums.append(before + 0.5e-9 * gap_ns * (self._rate + rate_rps) if self._stamps else 0.0)
        self._stamps.append(stamp_ns)
        self._rate = rate_rps
        if len(self._stamps) > 2 * _KEPT:
            del self._stamps[:_KEPT], self._sums[:_KEPT]

    def reached(self, stamp_ns: int) -> bool:
        """Whether no reading up to this stamp is missing any more: it is there, or the IMU is silent."""
        late_ns = self.late_ns
        return not self._stamps or not self._stamps[-1] < stamp_ns + late_ns <= self._stamps[-1] + _LONGEST_NS

    def turn(self, from_ns: int, to_ns: int) -> float | None:
        """The turn between two stamps without the bias (rad); None where readings are missing."""
        begin, end = self._sum(from_ns + self.late_ns), self._sum(to_ns + self.late_ns)
        return (
            None
            if begin is None or end is None
            else self.unit * (end - begin) - self.bias_rps * (to_ns - from_ns) * 1e-9
        )

    def observe(self, from_ns: int, to_ns: int, by_scans: float, by_wheels: float) -> None:
        """Take the turn of the robot between two scans, which were taken then, as scans and wheels say it (rad)."""
        self._steps.append((from_ns, to_ns, by_scans, by_wheels))
        while self._stamps and self._steps and self._steps[0][1] + _LATE_NS[-1] <= self._stamps[-1]:
            self._compare(*self._steps.popleft())

    def _compare(self, from_ns: int, to_ns: int, by_scans: float, by_wheels: float) -> None:
        if self._stamps[0] > from_ns + _LATE_NS[0]:
            return
        first = bisect_left(self._stamps, from_ns + _LATE_NS[0]) - 1
        last = bisect_left(self._stamps, to_ns + _LATE_NS[-1]) + 1
        times = np.array(self._stamps[max(first, 0) : last]) - from_ns
        sums = np.array(self._sums[max(first, 0) : last])
        raw = np.interp(to_ns - from_ns + _LATE_NS, times, sums) - np.interp(_LATE_NS, times, sums)
        raw = _UNITS[:, None] * raw
        elapsed_s = (to_ns - from_ns) * 1e-9
        self._time_s = _REMEMBERED * self._time_s + elapsed_s
        self._ahead = _REMEMBERED * self._ahead + (raw - by_scans)
        off = np.minimum(np.abs(raw - by_scans - self._ahead / self._time_s * elapsed_s), _LARGEST_RAD)
        self._off = _REMEMBERED * self._off + off**2
        self._wheels_off = _REMEMBERED * self._wheels_off + min(abs(wrap(by_wheels - by_scans)), _LARGEST_RAD) ** 2
        self._count = _REMEMBERED * self._count + 1.0
        self._turned = _REMEMBERED * self._turned + abs(by_scans)
        if self._count >= _LEAST_STEPS and self._turned >= _LEAST_TURN_RAD:
            better = self._off.min() < (1.0 if self.used else _BETTER) * self._wheels_off
            self.used = bool(better) and self.late_ns <= _LATEST_NS

    def remark(self) -> str:
        """What became of the IMU, in words; nothing where there is none."""
        if not self._heard:
            return ""
        if self._count < 1.0:
            return (
                "the IMU is not used: nothing could be compared with it, for want of wheels, of stamps of one clock or "
                "of five readings a second"
            )
        deviations = [math.degrees(math.sqrt(off / self._count)) for off in (self._off.min(), self._wheels_off)]
        late = ", its rates being in degrees/s" if self.unit != 1.0 else ""
        late += f", with stamps {self.late_ns * 1e-9:.2f} s late" if self.late_ns else ""
        beside = (
            f"its turns are {deviations[0]:.2f} deg off from scan to scan{late}, the wheels' {deviations[1]:.2f} deg"
        )
        if self.used:
            return f"the IMU's turns stand in for the wheels': {beside}"
        return f"the IMU is not used: {beside}"

    def _sum(self, stamp_ns: int) -> float | None:
        stamps, sums = self._stamps, self._sums
        if not stamps or not stamps[0] <= stamp_ns <= stamps[-1]:
            return None
        after = max(bisect_left(stamps, stamp_ns), 1)
        if after == len(stamps):
            return sums[-1]
        share = (stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        return sums[after - 1] + share * (sums[after] - sums[after - 1])
