"""What two range scans share, compiled; ``overlaps.shared_views`` says what it is."""

import math

from numba import njit

from ngo_estimator.graph.block_cholesky import Array

_DRIFT_M = 0.5
"""Deviation of a position under which frames are compared."""

_AGREEING = 5.0
"""Ranges agree that differ by so many of their deviations, and half of the drift."""

_EVERY = 3
"""One of so many rays shows whether frames share what they see."""


@njit(cache=True, error_model="numpy")
def share_views(
    a: Array, b: Array, relative: Array, cos: Array, sin: Array, settings: tuple[float, float, float], share: Array
) -> None:
    """Fill ``share`` ``(n,)`` for ranges ``a`` and ``b`` ``(n, rays)`` and poses ``relative`` ``(n, 3)``.

    ``cos`` and ``sin`` ``(rays,)`` of the rays; ``settings``: half of the field of view (rad), noise (m) and its share.
    """
    for k in range(len(relative)):
        x, y, yaw = relative[k]
        share[k] = _seen_again(a[k], b[k], (x, y, yaw), cos, sin, settings)
        if share[k] > 0.0:
            turn_x, turn_y = math.cos(yaw), math.sin(yaw)
            inverse = (-turn_x * x - turn_y * y, turn_y * x - turn_x * y, -yaw)
            share[k] = min(share[k], _seen_again(b[k], a[k], inverse, cos, sin, settings))


@njit(cache=True, error_model="numpy")
def _seen_again(
    a: Array,
    b: Array,
    relative: tuple[float, float, float],
    cos: Array,
    sin: Array,
    settings: tuple[float, float, float],
) -> float:
    """Share of some rays of ``b`` that end where ``a`` sees a wall."""
    half, noise, noise_share = settings
    turn_x, turn_y = math.cos(relative[2]), math.sin(relative[2])
    meets, count = 0, 0
    farthest = a.max()
    farthest += 0.5 * _DRIFT_M + _AGREEING * (noise + noise_share * farthest)
    for ray in range(0, len(b), _EVERY):
        count += 1
        if not b[ray] > 0.0:
            continue
        x, y = b[ray] * cos[ray], b[ray] * sin[ray]
        seen_x, seen_y = turn_x * x - turn_y * y + relative[0], turn_y * x + turn_x * y + relative[1]
        distance = math.sqrt(seen_x * seen_x + seen_y * seen_y)
        if not distance < farthest:
            continue
        at = round((half - math.atan2(seen_y, seen_x)) * (len(a) - 1) / (2.0 * half))
        if at < 0 or at > len(a) - 1 or not a[at] > 0.0:
            continue
        tolerance = 0.5 * _DRIFT_M + _AGREEING * (noise + noise_share * a[at])
        meets += abs(distance - a[at]) < tolerance
    return meets / count
