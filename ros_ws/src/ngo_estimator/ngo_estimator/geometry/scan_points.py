"""A raw scan as a ``KeyScan``: thinned points with normals, the sweep's motion removed."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import Array, rotated, transformed

_LEAST_TRIPLES = 20
"""Triples of neighbouring rays without which a scan's noise is not estimated."""

_WIDEST_TRIPLE_RAD = 0.2
"""Between the outer rays of such a triple."""

_QUARTER = 0.3186
"""Deviations within which a quarter of a normal distribution lies."""

_WITHIN_NOISE = 3.0
"""Deviations of a range within which two ranges tell no distance: else noise would choose which points begin a mean."""

_LARGEST_NOISE_M = 0.06
"""Larger estimates come from clutter."""


@dataclass(frozen=True)
class ScanPointsConfig:
    """How a scan's rays become points.

    ``spacing_m`` is the least length of surface that gets a point of its own; rays closer together are averaged.
    ``most_points`` widens the spacing of scans that would have more points. ``neighbours`` points to each side make a
    normal. ``thickness_m`` is the largest deviation of these points from their line, beside ``thickness_share`` of the
    range. Noisy scans get a spacing of at least ``spacing_noise`` and a thickness of at least ``thickness_noise``
    standard deviations of a range. A line that passes the sensor closer than ``edge_on`` times its range joins two
    surfaces, and is none.
    """

    spacing_m: float = 0.04
    most_points: int = 400
    neighbours: int = 4
    thickness_m: float = 0.03
    thickness_share: float = 0.002
    spacing_noise: float = 2.0
    thickness_noise: float = 1.0
    edge_on: float = 0.08

    def __post_init__(self) -> None:
        check_positive(self, "spacing_m thickness_m")
        check(self, "most_points", "at least 10", lambda x: x >= 10)
        check(self, "neighbours", "at least 1", lambda x: x >= 1)
        check(self, "spacing_noise thickness_noise", "finite, from 0 on", lambda x: 0.0 <= x < math.inf)
        check(self, "thickness_share edge_on", "a share of 0 to below 1", lambda x: 0.0 <= x < 1.0)


@dataclass(frozen=True, eq=False)
class Mounting:
    """Where the sensor sits: its pose ``sensor_xyyaw`` ``(3,)`` in the base frame, whether it is ``upside_down``
    (rolled by half a turn: its counter-clockwise is clockwise seen from above), and its height above the base frame
    ``height_m``, 0 where that is not known."""

    sensor_xyyaw: Array
    upside_down: bool = False
    height_m: float = 0.0

    def __post_init__(self) -> None:
        if self.sensor_xyyaw.shape != (3,) or not np.isfinite(self.sensor_xyyaw).all():
            raise ValueError(f"sensor_xyyaw is {self.sensor_xyyaw}; expected three finite numbers")


@dataclass(frozen=True, eq=False)
class Sweep:
    """How the robot moved while the rays were measured: the time of each ray after the scan's stamp ``offsets_s``
    ``(m,)`` and the base's velocity ``twist`` ``(3,)`` in its own frame (m/s, m/s, rad/s)."""

    offsets_s: Array
    twist: Array


def key_scan(
    stamp_ns: int,
    angles: Array,
    ranges: Array,
    range_limits: tuple[float, float],
    mounting: Mounting,
    sweep: Sweep | None = None,
    config: ScanPointsConfig | None = None,
) -> KeyScan:
    """The scan in the robot's base frame at its stamp.

    Args:
        stamp_ns: stamp of the scan.
        angles: directions of the rays ``(m,)`` in the sensor's frame (rad), increasing or decreasing.
        ranges: what they measured ``(m,)`` (m). Values beyond the limits, infinite ones and zero are no return, NaN is
            unknown.
        range_limits: least and largest range that the sensor measures (m).
        mounting: pose of the sensor.
        sweep: motion during the scan, which is removed.
        config: how points and normals are made.

    Raises:
        ValueError: shapes disagree, angles are not finite, or the limits are not in order.
    """
    config = config or ScanPointsConfig()
    angles, ranges = _checked(angles, ranges, range_limits)
    if mounting.upside_down:
        angles = -angles
    least, largest = range_limits
    returned = (ranges > max(least, 0.0)) & (ranges < largest)
    # Too near is unknown: the robot's own body, or glare. Too far is free space.
    ranges = np.where(returned, ranges, np.where(ranges >= largest, np.inf, np.nan))
    if sweep is not None:
        angles, ranges = _without_motion(angles, ranges, mounting.sensor_xyyaw, sweep)
    order = np.argsort(angles, kind="stable")
    angles, ranges = angles[order], ranges[order]
    numbers = config.spacing_m, config.spacing_noise, config.thickness_m, config.thickness_noise
    shares = config.thickness_share, config.edge_on
    points, normals = _surfaces(
        angles, ranges, mounting.sensor_xyyaw, numbers, config.most_points, config.neighbours, shares
    )
    # What messages carry: a live node sees the same as a run over a recording.
    angles, ranges = (part.astype(np.float32).astype(np.float64) for part in (angles, ranges))
    return KeyScan(stamp_ns, points, normals, mounting.sensor_xyyaw, angles, ranges, float(np.float32(largest)))


@njit(cache=True)
def _surfaces(
    angles: Array, ranges: Array, sensor: Array, numbers: tuple[float, float, float, float], most: int,
    neighbours: int, shares: tuple[float, float],
) -> tuple[Array, Array]:  # fmt: skip
    """Points and normals ``(n, 2)`` in the base frame, as single floats hold them, of rays by increasing angle."""
    spacing, spacing_noise, thickness, thickness_noise = numbers
    seen = np.isfinite(ranges)
    polar, distance = angles[seen], ranges[seen]
    ends = np.empty((len(polar), 2))
    ends[:, 0], ends[:, 1] = distance * np.cos(polar), distance * np.sin(polar)
    noise = range_noise(polar, distance)
    thin = _thinned(ends, distance, max(spacing, spacing_noise * noise), _WITHIN_NOISE * noise, most)
    normals = _normals(thin, neighbours, max(thickness, thickness_noise * noise), *shares)
    points, normals = transformed(sensor, thin), rotated(sensor[2], normals)
    return points.astype(np.float32).astype(np.float64), normals.astype(np.float32).astype(np.float64)


@njit(cache=True)
def range_noise(angles: Array, ranges: Array) -> float:
    """Standard deviation of a range (m), from rays at rising ``angles`` ``(m,)`` (rad) with finite ``ranges`` ``(m,)``.

    Three neighbouring rays on a straight wall determine the middle one: 1 / range is a sinusoid of the angle. The
    smallest quarter of the differences counts, since clutter adds to the others. Scans of few rays give 0.
    """
    if len(ranges) < _LEAST_TRIPLES + 2:
        return 0.0
    off, count = np.empty(len(ranges) - 2), 0
    for k in range(1, len(ranges) - 1):
        left, right = angles[k] - angles[k - 1], angles[k + 1] - angles[k]
        if not (left > 0.0 and right > 0.0 and left + right < _WIDEST_TRIPLE_RAD):
            continue
        before, after, both = ranges[k - 1], ranges[k + 1], math.sin(left + right)
        share_before, share_after = math.sin(right) / both, math.sin(left) / both
        expected = 1.0 / (share_before / before + share_after / after)
        # Sensitivities of the expected range to both neighbours.
        of_before, of_after = share_before * (expected / before) ** 2, share_after * (expected / after) ** 2
        off[count] = abs(ranges[k] - expected) / math.sqrt(1.0 + of_before**2 + of_after**2)
        count += 1
    if count < _LEAST_TRIPLES:
        return 0.0
    return min(np.quantile(off[:count], 0.25) / _QUARTER, _LARGEST_NOISE_M)


def _checked(angles: Array, ranges: Array, range_limits: tuple[float, float]) -> tuple[Array, Array]:
    angles, ranges = np.asarray(angles, dtype=np.float64), np.asarray(ranges, dtype=np.float64)
    if angles.ndim != 1 or angles.shape != ranges.shape:
        raise ValueError(f"angles and ranges have shapes {angles.shape} and {ranges.shape}; expected (m,) twice")
    if not np.isfinite(angles).all():
        raise ValueError("angles are not finite; expected the direction of every ray")
    least, largest = range_limits
    if not 0.0 <= least < largest < math.inf:
        raise ValueError(f"range_limits are {range_limits}; expected 0 <= least < largest, both finite")
    return angles, ranges


def _without_motion(angles: Array, ranges: Array, sensor: Array, sweep: Sweep) -> tuple[Array, Array]:
    """The rays as a sensor that stood still at the scan's stamp would have seen their ends."""
    offsets, twist = np.asarray(sweep.offsets_s, dtype=np.float64), np.asarray(sweep.twist, dtype=np.float64)
    if offsets.shape != angles.shape or twist.shape != (3,):
        raise ValueError(f"offsets_s and twist have shapes {offsets.shape} and {twist.shape}; expected (m,) and (3,)")
    if not (np.isfinite(offsets).all() and np.isfinite(twist).all()):
        raise ValueError("offsets_s or twist are not finite; expected finite numbers")
    turn = twist[2] * offsets
    # Constant twist: the chord lies at half of the turn; its length differs from the arc's by the square of the turn.
    half = 0.5 * turn
    x = np.cos(half) * twist[0] * offsets - np.sin(half) * twist[1] * offsets
    y = np.sin(half) * twist[0] * offsets + np.cos(half) * twist[1] * offsets
    reach = np.where(np.isfinite(ranges), ranges, 0.0)
    in_base = sensor[2] + angles
    base_x, base_y = sensor[0] + reach * np.cos(in_base), sensor[1] + reach * np.sin(in_base)
    still_x = x + np.cos(turn) * base_x - np.sin(turn) * base_y - sensor[0]
    still_y = y + np.sin(turn) * base_x + np.cos(turn) * base_y - sensor[1]
    seen = np.isfinite(ranges)
    bearing = np.arctan2(still_y, still_x) - sensor[2]
    # Kept near the ray's own angle, so that the order survives a full turn.
    bearing = angles + (bearing - angles + math.pi) % (2.0 * math.pi) - math.pi
    return np.where(seen, bearing, angles + turn), np.where(seen, np.hypot(still_x, still_y), ranges)


@njit(cache=True)
def _thinned(points: Array, ranges: Array, spacing: float, noise: float, most: int) -> Array:
    """Means of neighbouring points ``(n, 2)`` that lie within the spacing, which grows until there are few enough.

    Of their distance along the ray the ``noise`` does not count.
    """
    result = np.empty_like(points)
    while True:
        count, first = 0, 0
        for i in range(1, len(points) + 1):
            if i < len(points):
                squared = (points[i, 0] - points[first, 0]) ** 2 + (points[i, 1] - points[first, 1]) ** 2
                along = abs(ranges[i] - ranges[first])
                across = squared - along * along  # of points as far away as each other
                if across + max(along - noise, 0.0) ** 2 < spacing * spacing:
                    continue
            x, y = 0.0, 0.0
            for j in range(first, i):
                x += points[j, 0]
                y += points[j, 1]
            result[count, 0], result[count, 1] = x / (i - first), y / (i - first)
            count, first = count + 1, i
        if count <= most:
            return result[:count].copy()
        spacing *= 1.25


@njit(cache=True)
def _normals(points: Array, neighbours: int, thickness: float, share: float, edge_on: float) -> Array:
    """Normals ``(n, 2)`` of lines through neighbouring points, towards the origin; zero where the points make no line.

    A point beside a corner takes its line from one side alone.
    """
    count = len(points)
    normals = np.zeros_like(points)
    joined = np.zeros(count, dtype=np.bool_)  # with the next point, on one surface
    for i in range(count - 1):
        x, y = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
        length = math.hypot(x, y)
        near = min(math.hypot(points[i, 0], points[i, 1]), math.hypot(points[i + 1, 0], points[i + 1, 1]))
        passes = abs(x * points[i, 1] - y * points[i, 0])
        joined[i] = length < 0.1 or (length < 1.5 and passes > edge_on * near * length)
    for i in range(count):
        low, high = i, i
        while low > 0 and i - low < neighbours and joined[low - 1]:
            low -= 1
        while high < count - 1 and high - i < neighbours and joined[high]:
            high += 1
        reach = math.hypot(points[i, 0], points[i, 1])
        tolerance = thickness + share * reach
        best, best_x, best_y = tolerance, 0.0, 0.0
        for side in range(3):
            first = i if side == 2 else low
            last = i if side == 1 else high
            if last - first < 2:
                continue
            off, normal_x, normal_y = _line(points, first, last)
            if off < best:
                best, best_x, best_y = off, normal_x, normal_y
                if side == 0:
                    break
        towards = best_x * points[i, 0] + best_y * points[i, 1]
        if abs(towards) > edge_on * reach:
            sign = -1.0 if towards > 0.0 else 1.0
            normals[i, 0], normals[i, 1] = sign * best_x, sign * best_y
    return normals


@njit(cache=True)
def _line(points: Array, first: int, last: int) -> tuple[float, float, float]:
    """Root mean square deviation of points ``first`` to ``last`` from their line, and the line's normal."""
    n = last - first + 1
    mean_x, mean_y = 0.0, 0.0
    for j in range(first, last + 1):
        mean_x += points[j, 0] / n
        mean_y += points[j, 1] / n
    xx, xy, yy = 0.0, 0.0, 0.0
    for j in range(first, last + 1):
        x, y = points[j, 0] - mean_x, points[j, 1] - mean_y
        xx += x * x / n
        xy += x * y / n
        yy += y * y / n
    half_gap = math.hypot(0.5 * (xx - yy), xy)
    smallest = max(0.5 * (xx + yy) - half_gap, 0.0)
    direction = 0.5 * math.atan2(2.0 * xy, xx - yy)
    if 0.5 * (xx + yy) + half_gap < 1e-4:  # all points in one place
        return math.inf, 0.0, 0.0
    return math.sqrt(smallest), -math.sin(direction), math.cos(direction)
