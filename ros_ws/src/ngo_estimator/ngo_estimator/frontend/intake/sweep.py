"""How long a scanner sweeps and which way, measured: drivers turn arrays round, and give times in other units.

Two scans that were taken at different velocities are bent differently. Both are registered to each other with the time
of a sweep as a fourth unknown beside their relative pose. What is measured stands against what the driver says, which
counts as long as nothing contradicts it.
"""

import math
import statistics
from collections import deque
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ngo_estimator.geometry.planar_motion import Array, between, compose, transformed
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan

_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Drivers give the time from ray to ray in s, ms, us or ns, or that of the whole sweep."""

_LONGEST = 1.2
_SHORTEST = 0.02
"""A sweep, in times from scan to scan."""

_KEPT = 12
"""Scans among which the second one of a pair is looked for."""

_FAR_M, _FAR_RAD = 0.6, 1.0
_LEAST_BEND_M = 0.015
"""By which the sweep's time bends two scans of a pair differently at 3 m, if it were the time from scan to scan."""

_FEWEST = 12
_PAIRS = 120
_DEVIATIONS = 5.0
_OFF = 0.35
"""What is measured is another sweep where it is off by this share of the scans' period, and surer than that."""

_NEAR = 0.45
"""Share of the period within which a measured sweep is one of those that drivers make: noise makes it shorter."""

_ONCE_KNOWN = 60
_TRIED = 150
"""One scan in so many is measured where the sweep is known, or so many others did not tell it."""

_KERNEL_M = 0.03
_GATES_M = (0.4, 0.4, 0.25, 0.15, 0.15, 0.1)
_SOURCES, _TARGETS = 160, 480


_Seen = tuple[Array, Array, Array]
_Taken = tuple[Array, Array, _Seen]
"""Pose in odom and velocity at a scan, and what it shows."""


class MeasuredSweep:
    """Measures the sweep of one scanner by its scans and the robot's motion, and corrects the scans' times."""

    def __init__(self) -> None:
        self.reversed = False
        """Whether the rays are in the other order than the driver says."""
        self.known_s: float | None = None
        """The time of a sweep (s) where what the driver says of it is of no use; negative against the rays' order."""
        self.unit = 1.0
        """Factor on the driver's times."""
        self._last_ns: int | None = None
        self._gaps: deque[float] = deque(maxlen=30)
        self._period_s = 0.0
        self._scans: dict[int, LidarScan] = {}
        self._taken: deque[_Taken] = deque(maxlen=_KEPT + 2)
        self._pose = np.zeros(3)
        self._found: deque[tuple[float, float]] = deque(maxlen=_PAIRS)
        self._since = self._tried = 0
        self._known = False

    def interrupt(self) -> None:
        """What comes is not measured against what came; what was learned stays."""
        self._scans.clear()
        self._taken.clear()
        self._last_ns = None

    def forget(self) -> None:
        """Measure anew: the motions that it was measured by were wrong."""
        self._found.clear()
        self._tried, self._known = 0, False
        self.reversed, self.known_s = False, None

    def correct(self, scan: LidarScan) -> LidarScan:
        """The scan with its rays in the order in which they were measured, and with their time.

        Times of single rays are believed, and not measured.
        """
        if scan.offsets_s is not None:
            return scan
        if self._last_ns is not None and scan.stamp_ns > self._last_ns:
            self._gaps.append((scan.stamp_ns - self._last_ns) * 1e-9)
            self._period_s = statistics.median(self._gaps) if len(self._gaps) > 2 else 0.0
        self._last_ns = scan.stamp_ns
        self._scans[scan.stamp_ns] = scan
        while len(self._scans) > 4 * _KEPT:
            self._scans.pop(next(iter(self._scans)))
        time_s = self._time_s(scan)
        count = len(scan.ranges)
        if time_s == scan.time_increment * count:
            return scan
        if time_s >= 0.0:
            return replace(scan, time_increment=time_s / count)
        return replace(
            scan,
            angle_min=scan.angle_min + scan.angle_increment * (count - 1),
            angle_increment=-scan.angle_increment,
            ranges=scan.ranges[::-1],
            time_increment=-time_s / count,
        )

    def _time_s(self, scan: LidarScan) -> float:
        """The time of the sweep (s) as it is believed."""
        if self.known_s is not None:
            return self.known_s
        return -self._given_s(scan) if self.reversed else self._given_s(scan)

    def _given_s(self, scan: LidarScan) -> float:
        """The time of the sweep as the driver says it, in a unit in which it can be; else 0."""
        given_s, period_s = scan.time_increment * len(scan.ranges), self._period_s
        if given_s == 0.0 or period_s == 0.0:
            return given_s
        units = [
            unit
            for unit in (*_UNITS, 1.0 / len(scan.ranges))
            if _SHORTEST * period_s <= abs(given_s * unit) <= _LONGEST * period_s
        ]
        if not units:
            return given_s if abs(given_s) < period_s else 0.0
        full_s = self._full_s(scan)
        self.unit = 1.0 if 1.0 in units else min(units, key=lambda unit: abs(math.log(abs(given_s * unit) / full_s)))
        return given_s * self.unit

    def _full_s(self, scan: LidarScan) -> float:
        """The time of the sweep (s) of a scanner that turns evenly, a turn a scan."""
        return self._period_s * min(abs(scan.angle_increment) * len(scan.ranges) / math.tau, 1.0)

    def observe(self, stamp_ns: int, step: Array, motion: Array | None, elapsed_s: float, mounting: Mounting) -> None:
        """Take the motion ``(3,)`` that led to a scan: by the scans, and by the wheels where there are any."""
        self._since += 1
        every = _ONCE_KNOWN if self._known or self._tried > _TRIED else 2
        if self._since < every - _KEPT:
            self._taken.clear()
            return
        self._pose = compose(self._pose, step)
        scan = self._scans.get(stamp_ns)
        if scan is None or elapsed_s <= 0.0:
            self._taken.clear()
            return
        velocity = (step if motion is None else motion) / elapsed_s
        if self._taken:  # the robot moved so before and after the scan before
            pose, twist, seen = self._taken.pop()
            self._taken.append((pose, 0.5 * (twist + velocity), seen))
            if self._since >= every:
                self._since = 0
                self._measure(scan)
        self._taken.append((self._pose, velocity, _seen(scan, mounting)))

    def remark(self) -> str:
        """What the driver says wrongly of the sweep, in words; nothing where it is right."""
        if self.reversed:
            return "its rays were measured in the other order than the driver says: corrected"
        if self.known_s is not None:
            way = "against the order of its rays" if self.known_s < 0.0 else "in the order of its rays"
            return f"its sweep lasts {abs(self.known_s):.3f} s {way}, the driver says something else: corrected"
        return f"its times from ray to ray are taken times {self.unit:g}" if self.unit != 1.0 else ""

    def _measure(self, scan: LidarScan) -> None:
        """The sweep by the newest one taken, like ``scan``."""
        newest, period_s = self._taken[-1], self._period_s
        best, bend = None, _LEAST_BEND_M
        for other in list(self._taken)[:-1]:
            off = between(other[0], newest[0])
            if math.hypot(off[0], off[1]) > _FAR_M or abs(off[2]) > _FAR_RAD:
                continue
            change = np.abs(newest[1] - other[1])
            size = period_s * (math.hypot(change[0], change[1]) + 3.0 * change[2])
            if size > bend:
                best, bend = other, size
        if best is None:
            return
        self._tried += 1
        start_s = abs(self._given_s(scan)) or period_s
        fits = [fit for sign in (1.0, -1.0) if (fit := _fit(best, newest, sign * start_s)) is not None]
        if fits:
            cost, time_s, deviation_s = min(fits)
            if math.isfinite(cost) and abs(time_s) < 2.0 * period_s:
                self._found.append((time_s, deviation_s))
        self._decide(scan)

    def _decide(self, scan: LidarScan) -> None:
        if len(self._found) < _FEWEST:
            return
        times, deviations = np.array(self._found).T
        weights = 1.0 / (deviations**2 + (0.1 * self._period_s) ** 2)
        order = np.argsort(times)
        share = np.cumsum(weights[order]) / weights.sum()
        low, measured, high = np.interp((0.25, 0.5, 0.75), share, times[order])
        spread = max(0.74 * (high - low), float(1.0 / math.sqrt(weights.sum() / len(times)))) / math.sqrt(len(times))
        believed_s = self._time_s(scan)
        self._known = _DEVIATIONS * spread < _OFF * self._period_s  # more of them would decide the same
        if not self._known or abs(measured - believed_s) < _OFF * self._period_s:
            return
        # Errors of the motion make a sweep look shorter, never longer.
        if believed_s != 0.0 and 0.0 <= measured / believed_s <= 1.0:
            return
        given_s = self._given_s(scan)
        full_s = self._full_s(scan)
        near = [t for t in (given_s, -given_s, full_s, -full_s, 0.0) if abs(t - measured) < _NEAR * self._period_s]
        known_s = near[0] if near else float(measured)
        self.reversed = known_s == -given_s
        self.known_s = None if abs(known_s) == abs(given_s) else known_s


def _seen(scan: LidarScan, mounting: Mounting) -> _Seen:
    """Points ``(n, 2)`` in the base frame as if the robot stood, their share of the sweep, and normals."""
    angles, ranges = scan.angles, scan.ranges.astype(np.float64)
    largest = scan.range_max if 0.0 < scan.range_max < math.inf else 1000.0
    seen = np.flatnonzero((ranges > max(scan.range_min, 0.0)) & (ranges < largest))
    angles, ranges = angles[seen], ranges[seen]
    turned = -angles if mounting.upside_down else angles
    points = transformed(mounting.sensor_xyyaw, np.stack((ranges * np.cos(turned), ranges * np.sin(turned)), axis=-1))
    normals = np.zeros_like(points)
    if len(points) > 4:
        along = points[4:] - points[:-4]
        length = np.linalg.norm(along, axis=1)
        close = (length > 1e-3) & (length < 0.1 + 0.1 * ranges[2:-2]) & (np.diff(seen)[1:-2] == 1)
        unit = along / np.maximum(length, 1e-9)[:, None]
        middle = points[2:-2] - 0.5 * (points[4:] + points[:-4])
        across = np.stack((-unit[:, 1], unit[:, 0]), axis=-1)
        flat = close & (np.abs((middle * across).sum(axis=1)) < 0.03)
        normals[2:-2][flat] = across[flat]
    return points, seen / max(len(scan.ranges), 1), normals


def _fit(first: _Taken, second: _Taken, time_s: float) -> tuple[float, float, float] | None:
    """Mean cost of the registration, the time of the sweep (s) and its deviation, from a first guess of it."""
    (begin, first_twist, (target, target_share, normal)), (end, second_twist, (source, source_share, _)) = first, second
    on_line = np.flatnonzero(normal.any(axis=1))
    on_line = on_line[:: max(1, len(on_line) // _TARGETS)]
    chosen = np.arange(0, len(source), max(1, len(source) // _SOURCES))
    if len(on_line) < 30 or len(chosen) < 30:
        return None
    target, normal, source = target[on_line], normal[on_line], source[chosen]
    target_rate = target_share[on_line, None] * _velocities(first_twist, target)
    source_rate = source_share[chosen, None] * _velocities(second_twist, source)
    pose, cost, information, noise = between(begin, end), math.inf, 0.0, 1.0
    for gate in _GATES_M:
        there, here = target + time_s * target_rate, source + time_s * source_rate
        moved = transformed(pose, here)
        distance, nearest = cKDTree(there).query(moved, distance_upper_bound=gate)
        hit = np.isfinite(distance)
        if hit.sum() < 25:
            return None
        index = nearest[hit]
        n = normal[index]
        residual = ((moved[hit] - there[index]) * n).sum(axis=1)
        turned = transformed(np.array((0.0, 0.0, pose[2])), source_rate[hit])
        lever = moved[hit] - pose[:2]
        jacobian = np.column_stack(
            (n, n[:, 1] * lever[:, 0] - n[:, 0] * lever[:, 1], ((turned - target_rate[index]) * n).sum(axis=1))
        )
        weight = 1.0 / (1.0 + (residual / _KERNEL_M) ** 2)
        normal_matrix = (jacobian * weight[:, None]).T @ jacobian + np.diag((1e-6, 1e-6, 1e-6, 1e-9))
        change = -np.linalg.solve(normal_matrix, (jacobian * weight[:, None]).T @ residual)
        pose = pose + change[:3]
        time_s += float(change[3])
        noise = max(1.48 * float(np.median(np.abs(residual))), 0.002)
        marginal = normal_matrix[3, 3] - normal_matrix[3, :3] @ np.linalg.solve(
            normal_matrix[:3, :3], normal_matrix[:3, 3]
        )
        information = max(float(marginal), 1e-12)
        cost = float(np.log1p((residual / _KERNEL_M) ** 2).mean()) + float((~hit).mean())
    return cost, time_s, noise / math.sqrt(information)


def _velocities(twist: Array, points: Array) -> Array:
    """Velocities ``(n, 2)`` of points that move with the robot."""
    return np.stack((twist[0] - twist[2] * points[:, 1], twist[1] + twist[2] * points[:, 0]), axis=-1)
