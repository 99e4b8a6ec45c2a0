"""Loops over points for ``view_pose.py``: errors of rays that see points, and normal equations of a pose."""

import numpy as np
from numba import njit

Array = np.ndarray

_INVERSE_LIMITS = (1e-3, 10.0)
_NO_SLOPE = 1e-12


@njit(cache=True, error_model="numpy")
def _terms(
    origin: Array,
    ray: Array,
    inverse: float,
    seen: Array,
    pose: Array,
    centre: Array,
    errors: Array,
    by_pose: Array,
    by_inverse: Array,
) -> None:
    """Fill in what ``ray_errors`` returns of one point."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    ox = origin[0] - pose[0] - cos * centre[0] + sin * centre[1]
    oy = origin[1] - pose[1] - sin * centre[0] - cos * centre[1]
    oz = origin[2] - centre[2]
    # The vector to the point, times the inverse range, and how it changes with that, in base axes.
    tx, ty, vz = ray[0] + inverse * ox, ray[1] + inverse * oy, ray[2] + inverse * oz
    vx, vy = cos * tx + sin * ty, cos * ty - sin * tx
    ix, iy = cos * ox + sin * oy, cos * oy - sin * ox
    length = max(np.sqrt(vx * vx + vy * vy + vz * vz), 1e-9)
    ux, uy, uz = vx / length, vy / length, vz / length
    level = max(np.hypot(seen[0], seen[1]), 1e-9)
    for k in range(2):
        # Two unit vectors across the ray, the first of them level.
        ax, ay, az = -seen[1] / level, seen[0] / level, 0.0
        if k == 1:
            ax, ay, az = -seen[2] * ay, seen[2] * ax, seen[0] * ay - seen[1] * ax
        error = ax * ux + ay * uy + az * uz
        # Of the unit vector, by the vector: what is not along it, over its length.
        sx, sy, sz = (ax - error * ux) / length, (ay - error * uy) / length, (az - error * uz) / length
        errors[k] = error
        by_pose[k, 0] = -inverse * (sx * cos - sy * sin)
        by_pose[k, 1] = -inverse * (sx * sin + sy * cos)
        # When the base turns, the camera moves, too.
        by_pose[k, 2] = sx * (vy + inverse * centre[1]) - sy * (vx + inverse * centre[0])
        by_pose[k, 3] = -inverse * sz
        by_inverse[k] = sx * ix + sy * iy + sz * oz


@njit(cache=True, error_model="numpy")
def all_terms(
    origins: Array, rays: Array, inverse: Array, seen: Array, pose: Array, centre: Array
) -> tuple[Array, Array, Array]:
    """See ``view_pose.ray_errors``."""
    count = len(inverse)
    errors, by_pose, by_inverse = np.empty((count, 2)), np.empty((count, 2, 4)), np.empty((count, 2))
    for n in range(count):
        _terms(origins[n], rays[n], inverse[n], seen[n], pose, centre, errors[n], by_pose[n], by_inverse[n])
    return errors, by_pose, by_inverse


@njit(cache=True, error_model="numpy")
def _nearest_range(
    origin: Array,
    ray: Array,
    inverse: float,
    seen: Array,
    pose: Array,
    centre: Array,
    errors: Array,
    by_pose: Array,
    by_inverse: Array,
) -> float:
    """The inverse range of one point after a Newton step towards the ray that sees it."""
    _terms(origin, ray, inverse, seen, pose, centre, errors, by_pose, by_inverse)
    slope = max(by_inverse[0] ** 2 + by_inverse[1] ** 2, _NO_SLOPE)
    better = inverse - (by_inverse[0] * errors[0] + by_inverse[1] * errors[1]) / slope
    return min(max(better, _INVERSE_LIMITS[0]), _INVERSE_LIMITS[1])


@njit(cache=True, error_model="numpy")
def nearest_ranges(
    origins: Array, rays: Array, inverse: Array, seen: Array, pose: Array, centre: Array, steps: int
) -> Array:
    """See ``view_pose.triangulated``."""
    errors, by_pose, by_inverse, found = np.empty(2), np.empty((2, 4)), np.empty(2), inverse.copy()
    for n in range(len(inverse)):
        for _ in range(steps):
            found[n] = _nearest_range(origins[n], rays[n], found[n], seen[n], pose, centre, errors, by_pose, by_inverse)
    return found


@njit(cache=True, error_model="numpy")
def add_rays(
    origins: Array,
    rays: Array,
    inverse: Array,
    inverse_std: Array,
    unknown: Array,
    seen: Array,
    std_rad: Array,
    state: Array,
    centre: Array,
    kernel: float,
    normal: Array,
    gradient: Array,
) -> Array:
    """Add what rays say to the normal equations ``(5, 5)`` and ``(5,)`` of ``view_pose.fit_view``.

    Inverse ranges ``(n,)`` that nobody knows become those that suit the state ``(5,)`` best: they must not pull.

    Returns:
        Squared errors in deviations ``(n,)``.
    """
    errors, by_pose, by_inverse = np.empty(2), np.empty((2, 4)), np.empty(2)
    jacobian, squared = np.empty((2, 5)), np.empty(len(inverse))
    for n in range(len(inverse)):
        scale = 1.0 + state[4]
        if unknown[n]:
            scale = 1.0
            inverse[n] = _nearest_range(
                origins[n], rays[n], inverse[n], seen[n], state, centre, errors, by_pose, by_inverse
            )
        _terms(origins[n], rays[n], inverse[n] * scale, seen[n], state, centre, errors, by_pose, by_inverse)
        # Errors are wide along what the range leaves open, on top of the ray's own deviation each way.
        variance, a0, a1 = std_rad[n] ** 2, by_inverse[0] * inverse_std[n], by_inverse[1] * inverse_std[n]
        narrow = 1.0 / (variance * (variance + a0 * a0 + a1 * a1))
        w00, w01, w11 = 1.0 / variance - narrow * a0 * a0, -narrow * a0 * a1, 1.0 / variance - narrow * a1 * a1
        e0, e1 = errors[0], errors[1]
        squared[n] = w00 * e0 * e0 + 2.0 * w01 * e0 * e1 + w11 * e1 * e1
        robust = 1.0 / (1.0 + squared[n] / kernel**2)
        for k in range(2):
            for i in range(4):
                jacobian[k, i] = by_pose[k, i]
            jacobian[k, 4] = 0.0 if unknown[n] else by_inverse[k] * inverse[n]
        for i in range(5):
            j0 = robust * (w00 * jacobian[0, i] + w01 * jacobian[1, i])
            j1 = robust * (w01 * jacobian[0, i] + w11 * jacobian[1, i])
            gradient[i] += j0 * e0 + j1 * e1
            for j in range(5):
                normal[i, j] += j0 * jacobian[0, j] + j1 * jacobian[1, j]
    return squared
