"""Registration of pairs of range scans, compiled; ``scan_registration`` says what it does."""

import math
from typing import Any

import numpy as np
from numba import njit

from ngo_estimator.geometry.planar_motion import wrap

Array = np.ndarray[Any, Any]

_EDGE_ON = 0.08
"""A line that passes the scanner closer than this share of its range joins two surfaces, and is none."""

_ALIKE = 0.9
"""Least cosine between the directions of two surfaces that may be one."""

_FEWEST = 0.35
"""Share of the points seen by both scanners that must lie on their lines, or the start stands."""

_SEEN_BY_BOTH = 0.15
"""Share of the rays that are taken to be seen by both, where they are fewer."""

_FARTHEST = 25.0
"""Squared deviations of the prior, over three components, from which on scans and start contradict each other."""


@njit(cache=True, error_model="numpy")
def _surfaces(ranges: Array, cos: Array, sin: Array, surfaces: Array) -> None:
    """Of neighbouring points ``(rays - 1, 5)``: the first point, the normal of the line through both, its distance.

    The normal and the distance are 0 where there is no surface.
    """
    for k in range(len(ranges) - 1):
        x, y = ranges[k] * cos[k], ranges[k] * sin[k]
        along_x, along_y = ranges[k + 1] * cos[k + 1] - x, ranges[k + 1] * sin[k + 1] - y
        length = max(math.sqrt(along_x * along_x + along_y * along_y), 1e-6)
        normal_x, normal_y = -along_y / length, along_x / length
        distance = normal_x * x + normal_y * y
        nearer = min(ranges[k], ranges[k + 1])
        if not (nearer > 0.0 and abs(distance) > _EDGE_ON * nearer):
            normal_x, normal_y, distance = 0.0, 0.0, 0.0
        row = surfaces[k]
        row[0], row[1], row[2], row[3], row[4] = x, y, normal_x, normal_y, distance


@njit(cache=True, error_model="numpy")
def register_pairs(
    a: Array,
    b: Array,
    poses: Array,
    log_std: Array,
    cos: Array,
    sin: Array,
    settings: tuple[float, float, float, float, float],
    steps: int,
) -> None:
    """Register pairs; what is better than ``poses`` ``(n, 3)`` and ``log_std`` ``(n, 2)`` replaces them.

    ``settings``: noise of a range (m), its share of the range, widest and last tolerance, half of the field of view
    (rad).
    """
    noise, noise_share, widest, last_tolerance, half = settings
    rays = a.shape[1]
    increment = 2.0 * half / (rays - 1)
    of_a, of_b = np.empty((rays - 1, 5)), np.empty((rays - 1, 5))
    pose, prior = np.empty(3), np.empty(3)
    information, gradient, jacobian = np.empty((3, 3)), np.empty(3), np.empty(3)
    for pair in range(len(a)):
        _surfaces(a[pair], cos, sin, of_a)
        _surfaces(b[pair], cos, sin, of_b)
        start = poses[pair]
        away = (math.exp(2.0 * log_std[pair, 0]), math.exp(2.0 * log_std[pair, 1]))
        squares = 0.0
        for k in range(rays):
            squares += b[pair, k] * b[pair, k]
        # How far the points may be from where the start has them.
        farthest = math.sqrt(away[0] + away[1] * squares / rays)
        for c in range(3):
            pose[c], prior[c] = start[c], 1.0 / away[c // 2]
        solved, share = True, 0.0
        for step in range(steps):
            turn_x, turn_y = math.cos(pose[2]), math.sin(pose[2])
            tolerance = 2.0 * 0.25**step * min(farthest, 0.5 * widest)
            information[:] = 0.0
            for c in range(3):
                moved = start[c] - pose[c] if c < 2 else wrap(start[c] - pose[c])
                information[c, c], gradient[c] = prior[c], prior[c] * moved
            weights, both = 0.0, 0
            for k in range(rays - 1):
                x, y, normal_x, normal_y, there = of_b[k]
                if there == 0.0:
                    continue
                turned_x, turned_y = turn_x * x - turn_y * y, turn_y * x + turn_x * y
                seen_x, seen_y = turned_x + pose[0], turned_y + pose[1]
                place = (half - math.atan2(seen_y, seen_x)) / increment
                if not (place >= 0.0 and place < rays - 1):
                    continue
                _, _, line_x, line_y, line = of_a[min(int(place), rays - 2)]
                if line == 0.0:
                    continue
                both += 1
                if (
                    line_x * (turn_x * normal_x - turn_y * normal_y) + line_y * (turn_y * normal_x + turn_x * normal_y)
                    <= _ALIKE
                ):
                    continue
                variance = noise * noise + (x * x + y * y) * noise_share * noise_share
                distance = line_x * seen_x + line_y * seen_y - line
                off = distance / max(tolerance, last_tolerance * math.sqrt(variance))
                weight = 1.0 / (1.0 + off * off) ** 2
                weights += weight
                jacobian[0], jacobian[1], jacobian[2] = line_x, line_y, line_y * turned_x - line_x * turned_y
                for r in range(3):
                    weighted = weight / variance * jacobian[r]
                    gradient[r] -= weighted * distance
                    for c in range(3):
                        information[r, c] += weighted * jacobian[c]
            share = weights / max(float(both), _SEEN_BY_BOTH * rays)
            solved = solved and _move(information, gradient, pose)
        if solved and share >= _FEWEST:
            _take_where_better(start, prior, pose, information, log_std[pair])


@njit(cache=True, error_model="numpy")
def _move(information: Array, gradient: Array, pose: Array) -> bool:
    """Add the solution to a pose; returns whether there is one."""
    inverse = _inverse(information)
    change = inverse[:, 0] * gradient[0] + inverse[:, 1] * gradient[1] + inverse[:, 2] * gradient[2]
    if not np.isfinite(change).all():
        return False
    pose += change
    return True


@njit(cache=True, error_model="numpy")
def _inverse(m: Array) -> Array:
    """Of a symmetric matrix ``(3, 3)``; infinite or no number where there is none."""
    a, b, c = (
        m[1, 1] * m[2, 2] - m[1, 2] ** 2,
        m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2],
        m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1],
    )
    d, e, f = m[0, 0] * m[2, 2] - m[0, 2] ** 2, m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2], m[0, 0] * m[1, 1] - m[0, 1] ** 2
    return np.array(((a, b, c), (b, d, e), (c, e, f))) / (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c)


@njit(cache=True, error_model="numpy")
def _take_where_better(start: Array, prior: Array, pose: Array, information: Array, log_std: Array) -> None:
    moved = 0.0
    for c in range(3):
        moved += prior[c] * (pose[c] - start[c] if c < 2 else wrap(pose[c] - start[c])) ** 2
    covariance = _inverse(information)
    position = 0.5 * math.log(0.5 * (covariance[0, 0] + covariance[1, 1]))
    heading = 0.5 * math.log(covariance[2, 2])
    good = moved <= _FARTHEST and math.isfinite(position) and math.isfinite(heading) and np.isfinite(pose).all()
    if good:
        start[0], start[1], start[2] = pose[0], pose[1], wrap(pose[2])
        log_std[0], log_std[1] = position, heading
