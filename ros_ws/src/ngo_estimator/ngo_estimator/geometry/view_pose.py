"""The planar pose of a camera from rays to points whose ranges are known better or worse: one fit for all of them.

A point is where a ray ``(3,)`` from an earlier camera ends, at an inverse range (1/m) with a deviation. Of a known
range the point tells position and heading as in perspective-n-point; of an unknown range it tells what the epipolar
constraint does, for the error of a range moves a picture of the point along the epipolar line alone (Civera, Davison
and Montiel, Inverse depth parametrization for monocular SLAM, 2008).
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from ngo_estimator.geometry.se2 import wrap
from ngo_estimator.geometry.view_kernel import add_rays, all_terms, nearest_ranges

Array = np.ndarray

_ITERATIONS = 12
_SETTLED = 1e-6
INVERSE = 0.25
"""Inverse range at which to begin where nothing is known, 1/m."""

UNKNOWN_STD = 3.0
"""Deviation of an inverse range that nobody has measured, 1/m."""

_RANGED = 0.3
"""A range is known where its deviation is less than this share of it."""

_NO_SLOPE = 1e-12
_TRIANGULATIONS = 3
_MISSED = 6.0
"""Deviations by which rays that do not meet miss each other."""

_LEAST_WAY_M = 0.1
_WAY_STD_M, _WAY_STD_SHARE = 0.02, 0.05
"""Deviation of the way between two pictures, m, and as a share of it."""


@dataclass(frozen=True, eq=False)
class RangedRays:
    """Points along rays, in any one frame whose z is up.

    ``origins`` ``(n, 3)`` are where the camera was, ``rays`` ``(n, 3)`` unit vectors from there, ``inverse`` ``(n,)``
    inverse ranges (1/m) and ``inverse_std`` ``(n,)`` their deviations.
    """

    origins: Array
    rays: Array
    inverse: Array
    inverse_std: Array

    def __len__(self) -> int:
        return len(self.inverse)

    def extended(self, others: "RangedRays") -> "RangedRays":
        """These points, then the others."""
        return RangedRays(*(np.concatenate((getattr(self, x.name), getattr(others, x.name))) for x in fields(self)))

    def __getitem__(self, which: np.ndarray) -> "RangedRays":
        return RangedRays(self.origins[which], self.rays[which], self.inverse[which], self.inverse_std[which])

    @property
    def known(self) -> np.ndarray:
        """Which ranges are known well enough to tell a position ``(n,)``."""
        return self.inverse_std < _RANGED * self.inverse


@dataclass(frozen=True, eq=False)
class ViewPose:
    """A fitted ``pose`` ``(3,)``, its ``covariance`` ``(3, 3)`` in the frame of the points, and ``inlier`` ``(n,)``.

    ``rise`` is how much higher the camera is (m), ``scale`` the share by which inverse ranges are larger than given.
    """

    pose: Array
    covariance: Array
    inlier: np.ndarray
    rise: float = 0.0
    scale: float = 0.0


def camera_at(pose: Array, centre: Array) -> Array:
    """Where the camera ``centre`` ``(3,)`` of a robot at ``pose`` ``(3,)`` is."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x = pose[0] + cos * centre[0] - sin * centre[1]
    return np.array((x, pose[1] + sin * centre[0] + cos * centre[1], centre[2]))


def base_vectors(points: RangedRays, pose: Array, centre: Array) -> Array:
    """Vectors ``(n, 3)`` to the points, times their inverse ranges, from the camera in base axes at a pose."""
    towards = points.rays + points.inverse[:, None] * (points.origins - camera_at(pose, centre))
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    seen: Array = towards @ np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    return seen


def unmeasured(origin: Array, rays: Array, inverse: float) -> RangedRays:
    """Points along rays ``(n, 3)`` from one origin ``(3,)``, whose ranges nobody knows."""
    count = len(rays)
    return RangedRays(np.broadcast_to(origin, (count, 3)), rays, np.full(count, inverse), np.full(count, UNKNOWN_STD))


def ray_errors(points: RangedRays, seen: Array, pose: Array, centre: Array) -> tuple[Array, Array, Array]:
    """Errors of rays that see points from a pose, and how they change.

    Args:
        seen: unit rays ``(n, 3)`` in base axes.

    Returns:
        Errors ``(n, 2)`` (rad), their derivatives by the pose and the camera's height ``(n, 2, 4)``, and by the inverse
        range ``(n, 2)``.
    """
    result: tuple[Array, Array, Array] = all_terms(
        points.origins, points.rays, points.inverse, seen, pose, centre.copy()
    )
    return result


def triangulated(points: RangedRays, seen: Array, pose: Array, centre: Array, inverse: Array, steps: int = 1) -> Array:
    """Inverse ranges ``(n,)`` of points that suit rays ``(n, 3)`` from a pose best, by so many Newton steps."""
    found: Array = nearest_ranges(points.origins, points.rays, inverse, seen, pose, centre.copy(), steps)
    return found


def measured_ranges(
    points: RangedRays, seen: Array, std_rad: Array, pose: Array, centre: Array, unknown_m: float = 0.0
) -> tuple[Array, Array]:
    """Inverse ranges ``(n,)`` by both pictures together, and deviations ``(n,)``; see ``fit_view`` for what is given.

    A range is triangulated from the old ray to a point and the new one, and averaged with what is known of it. The way
    between the pictures is not known better than the motion that was given, which may leave ``unknown_m`` of it open.
    """
    fresh = triangulated(points, seen, pose, centre, points.inverse, _TRIANGULATIONS)
    errors, _, by_inverse = ray_errors(replace(points, inverse=fresh), seen, pose, centre)
    slope = np.maximum((by_inverse**2).sum(1), _NO_SLOPE)
    way = np.maximum(np.linalg.norm(points.origins - camera_at(pose, centre), axis=1), 1e-6)
    way_std = np.hypot(np.hypot(_WAY_STD_M, unknown_m) / way, _WAY_STD_SHARE)
    std = np.hypot(1.5 * std_rad / np.sqrt(slope), fresh * way_std)
    meets = np.linalg.norm(errors, axis=1) < _MISSED * std_rad
    std = np.where((way > _LEAST_WAY_M) & meets, std, UNKNOWN_STD)
    old, new = points.inverse_std**-2.0, std**-2.0
    return (old * points.inverse + new * fresh) / (old + new), (old + new) ** -0.5


def fit_view(
    points: RangedRays,
    seen: Array,
    std_rad: Array,
    centre: Array,
    start: Array,
    prior: tuple[Array, Array],
    scale_std: float,
    rise_std: float,
    kernel: float = 2.0,
) -> ViewPose:
    """The pose from which rays see points, with a prior on it, robustly.

    Args:
        seen: unit rays ``(n, 3)`` in base axes; std_rad: their deviations ``(n,)``.
        centre: of the camera in the base frame ``(3,)``.
        start: pose ``(3,)`` to begin at.
        prior: a pose ``(3,)`` and its information matrix ``(3, 3)``, in the frame of the points.
        scale_std: deviation of the share by which all inverse ranges are wrong together.
        rise_std: deviation of the camera's height, m: floors are not quite even.
        kernel: width of the Cauchy kernel in deviations; a ray is an inlier within one and a half of it.
    """
    mean, information = prior
    state = np.append(start, (0.0, 0.0))  # x, y, yaw; rise; share of the scale
    unknown, inverse = ~points.known, points.inverse.copy()
    nuisances = np.array((rise_std, scale_std)) ** -2.0
    for _ in range(_ITERATIONS):
        off = np.append(state[:2] - mean[:2], wrap(state[2] - mean[2]))
        normal, gradient = np.zeros((5, 5)), np.append(information @ off, nuisances * state[3:])
        normal[:3, :3], normal[(3, 4), (3, 4)] = information, nuisances
        at = centre + (0.0, 0.0, state[3])
        squared = add_rays(points.origins, points.rays, inverse, points.inverse_std, unknown, seen, std_rad, state, at,
                           kernel, normal, gradient)  # fmt: skip
        step = np.linalg.solve(normal, gradient)
        state -= step
        state[4] = np.clip(state[4], -0.5, 0.5)
        if np.abs(step).max() < _SETTLED:
            break
    covariance = np.linalg.inv(normal)[:3, :3]
    return ViewPose(state[:3], covariance, squared < (1.5 * kernel) ** 2, float(state[3]), float(state[4]))
