"""Stamped poses of the wheels, the pose at any time among them, and how late scans are by their clock."""

import math

import numpy as np
from numba import njit

from ngo_estimator.frontend.lidar.even_stamps import UsualPeriod
from ngo_estimator.geometry.planar_motion import Array, between, compose, wrap

_KEPT = 1024
_EXTRAPOLATED_S = 0.5
"""Wheels whose last pose is older are silent."""

_LAGS_S = np.linspace(-0.48, 0.48, 49)
_NONE = int(np.abs(_LAGS_S).argmin())
_REMEMBERED = 0.998
"""What a turn counts after the next one."""

_LEAST_TURNS = 60.0
"""Turns after which the lag counts."""

_TURNS_RAD = 0.02
"""A smaller turn between two scans tells no lag."""

_BETTER, _SURE, _OF_TURNS = 0.9, 1.5, 0.6
"""The lag must leave so much of what no lag leaves, less by so many deviations, and so much of all turns: the rest is
the wheels' noise."""


class StampedWheels:
    """Poses by time, in bounded memory; readings that came in a bunch are spread evenly."""

    def __init__(self) -> None:
        self._rows = np.empty((2 * _KEPT, 4))  # s since the first, x, y, unwrapped yaw
        self._count = self._bunch = 0  # the row before the bunch
        self._newest_s = 0.0  # as it was stamped
        self._origin_ns = 0
        self._period = UsualPeriod()
        self._pending: list[tuple[float, float, float]] = []
        self._off, self._squares = np.zeros((2, len(_LAGS_S)))  # sums, and squared differences from no lag
        self._turns = self._turned = 0.0
        self.lag_s = 0.0
        """How much older scans are than their stamps (s); 0 until it is known."""

    @property
    def newest_ns(self) -> int:
        """Stamp of the last pose."""
        return self._origin_ns + round(self._newest_s * 1e9)

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take the pose ``(3,)`` in the wheels' own frame; one that is not newer than the last is left out."""
        if self._count == 0:
            self._origin_ns = stamp_ns
            self._rows[0] = 0.0, *pose
            self._count = 1
            return
        stamp_s = (stamp_ns - self._origin_ns) * 1e-9
        gap_s = stamp_s - self._newest_s
        if gap_s <= 0.0:
            return
        self._period.add(gap_s)
        if self._count == len(self._rows):
            self._rows[:_KEPT] = self._rows[_KEPT:].copy()
            self._count, self._bunch = _KEPT, max(0, self._bunch - _KEPT)
        last = self._count - 1
        self._rows[self._count] = stamp_s, pose[0], pose[1], self._rows[last, 3] + wrap(pose[2] - self._rows[last, 3])
        self._count += 1
        self._newest_s = stamp_s
        if self._period.bunched(gap_s):
            self._rows[self._bunch : self._count, 0] = np.linspace(
                self._rows[self._bunch, 0], stamp_s, self._count - self._bunch
            )
        else:
            self._bunch = last

    def pose_at(self, stamp_s: float) -> Array | None:
        """The wheels' pose ``(3,)`` when a scan of this stamp (s since the epoch) was taken; None where they were
        silent."""
        return _known(_pose_at(self._rows[: self._count], stamp_s - self._origin_ns * 1e-9 - self.lag_s))

    def motion(self, from_s: float, to_s: float, calibration: Array) -> Array | None:
        """The robot's motion ``(3,)`` between two scans (s since the epoch), each reading's times ``calibration``
        ``(3, 3)``; None where the wheels were silent."""
        begin_s, end_s = (stamp_s - self._origin_ns * 1e-9 - self.lag_s for stamp_s in (from_s, to_s))
        return _known(_motion(self._rows[: self._count], begin_s, end_s, calibration))

    def gaps(self, from_s: float, to_s: float, longest_s: float) -> tuple[Array, Array]:
        """The gaps between readings, of more than ``longest_s``, that reach into the time between two stamps (s since
        the epoch): their lengths ``(n,)``, and how much of each lies within that time ``(n,)``, s."""
        rows = self._rows[: self._count, 0]
        begin_s, end_s = (stamp_s - self._origin_ns * 1e-9 for stamp_s in (from_s, to_s))
        first = int(np.searchsorted(rows, begin_s, side="right")) - 1
        near = rows[max(first, 0) : int(np.searchsorted(rows, end_s)) + 1]
        edges = np.concatenate(([min(begin_s, near[0])], near, [max(end_s, near[-1])]))
        lengths, inside = np.diff(edges), np.minimum(edges[1:], end_s) - np.maximum(edges[:-1], begin_s)
        long = (lengths > longest_s) & (inside > 0.0)
        return lengths[long], inside[long]

    def observe_turn(self, from_s: float, to_s: float, turn_rad: float) -> None:
        """Take how far the robot turned between two scans, by a match, to learn the lag."""
        self._pending.append((from_s - self._origin_ns * 1e-9, to_s - self._origin_ns * 1e-9, turn_rad))
        rows = self._rows[: self._count]
        while self._pending and self._pending[0][1] + _LAGS_S[-1] < self._newest_s:
            start, end, turn = self._pending.pop(0)
            if start + _LAGS_S[0] < rows[0, 0]:
                continue
            by_wheels = _turns(rows, start, end)
            if max(abs(turn), by_wheels.max(), -by_wheels.min()) < _TURNS_RAD:
                continue
            off = np.minimum(np.abs(by_wheels - turn), 10.0 * _TURNS_RAD)
            self._off = _REMEMBERED * self._off + off
            self._squares = _REMEMBERED**2 * self._squares + (off - off[_NONE]) ** 2
            self._turned = _REMEMBERED * self._turned + abs(turn)
            self._turns = _REMEMBERED * self._turns + 1.0
        if len(self._pending) > _KEPT:
            self._pending.pop(0)
        if self._turns > _LEAST_TURNS:
            self.lag_s = self._learned()

    def _learned(self) -> float:
        best = int(self._off.argmin())
        if best == _NONE or not 0 < best < len(_LAGS_S) - 1:
            return 0.0
        most = self._off[_NONE] - _SURE * math.sqrt(self._squares[best])
        if self._off[best] > min(_BETTER * self._off[_NONE], most, _OF_TURNS * self._turned):
            return self.lag_s
        left, here, right = self._off[best - 1 : best + 2]
        bend = left - 2.0 * here + right
        shift = 0.5 * (left - right) / bend if bend > 0.0 else 0.0
        return float(_LAGS_S[best] + shift * (_LAGS_S[1] - _LAGS_S[0]))


def _known(found: Array) -> Array | None:
    return None if np.isnan(found[0]) else found


@njit(cache=True)
def _pose_at(rows: Array, at: float) -> Array:
    """The pose ``(3,)`` at a time; no number where the wheels were silent."""
    if len(rows) == 0 or at < rows[0, 0] - _EXTRAPOLATED_S or at > rows[-1, 0] + _EXTRAPOLATED_S:
        return np.full(3, np.nan)
    if len(rows) == 1:
        return rows[0, 1:].copy()
    i = min(max(int(np.searchsorted(rows[:, 0], at)), 1), len(rows) - 1)
    share = (at - rows[i - 1, 0]) / (rows[i, 0] - rows[i - 1, 0])
    result: Array = rows[i - 1, 1:] + min(max(share, -1.0), 2.0) * (rows[i, 1:] - rows[i - 1, 1:])
    return result


@njit(cache=True)
def _turns(rows: Array, start_s: float, end_s: float) -> Array:
    """How far the wheels turned between two times, at each lag.

    A cubic B-spline has nearly the same noise at and between readings. Straight lines have less between them, so that
    noise alone would make a lag of half a period.
    """
    first = np.searchsorted(rows[:, 0], start_s - _LAGS_S[-1]) - 2
    last = np.searchsorted(rows[:, 0], end_s - _LAGS_S[0]) + 2
    near = rows[max(first, 0) : last]
    times, yaws = near[:, 0].copy(), near[:, 3].copy()
    result: Array = _smooth(times, yaws, end_s - _LAGS_S) - _smooth(times, yaws, start_s - _LAGS_S)
    return result


@njit(cache=True)
def _smooth(times: Array, values: Array, at: Array) -> Array:
    """A cubic B-spline of ``values`` ``(n,)`` at some times ``(k,)``."""
    places = np.interp(at, times, np.arange(len(times)).astype(np.float64))
    result = np.empty(len(at))
    for k in range(len(at)):
        i = min(int(places[k]), len(values) - 2)
        s = places[k] - i
        weights = (1.0 - s) ** 3, 3.0 * s**3 - 6.0 * s**2 + 4.0, 3.0 * s * (1.0 + s - s**2) + 1.0, s**3
        result[k] = sum([weights[j] / 6.0 * values[min(max(i + j - 1, 0), len(values) - 1)] for j in range(4)])
    return result


@njit(cache=True)
def _motion(rows: Array, begin_s: float, end_s: float, calibration: Array) -> Array:
    """The motion ``(3,)`` between two times, each reading's times ``calibration``; no number where they were silent."""
    last, end = _pose_at(rows, begin_s), _pose_at(rows, end_s)
    motion = np.zeros(3)
    for k in range(np.searchsorted(rows[:, 0], begin_s, side="right"), len(rows)):
        if rows[k, 0] > end_s:
            break
        motion = compose(motion, between(last, rows[k, 1:]) @ calibration)
        last = rows[k, 1:].copy()
    return compose(motion, between(last, end) @ calibration)
