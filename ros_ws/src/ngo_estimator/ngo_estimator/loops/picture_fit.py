"""The relative pose of two key pictures: matches, planar two-view geometry, and scale from triangulated points."""

from dataclasses import dataclass, replace

import numpy as np

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_picture import KeyPicture, matches
from ngo_estimator.geometry.planar_views import ransac
from ngo_estimator.geometry.view_pose import INVERSE, RangedRays, fit_view, measured_ranges, ray_errors, unmeasured
from ngo_estimator.loops.picture_settings import PictureLoopConfig

_WAYS_M = np.array((0.0, 0.15, 0.4, 0.8, 1.5, 2.5))
"""Lengths of the way that the fit may begin at."""

_ANYWHERE = np.diag((4.0, 4.0, 1.0))
"""Covariance of one picture seen from the other before they were compared (m, m, rad)."""


@dataclass(frozen=True)
class PictureFit:
    """A later picture seen from an earlier one ``(3,)``, the covariance ``(3, 3)``, and how many matches agree."""

    relative: np.ndarray
    covariance: np.ndarray
    inliers: int


def points_of(
    picture: KeyPicture, others: list[tuple[KeyPicture, np.ndarray]], config: PictureLoopConfig
) -> RangedRays:
    """The features of a picture, with ranges from pictures near it, each with its pose ``(3,)`` as seen from there."""
    points = unmeasured(picture.centre, picture.rays, INVERSE)
    for other, pose in others:
        pairs = matches(picture, other, config.ratio)
        if len(pairs) == 0:
            continue
        here, there = pairs.T
        std_rad = _deviations(picture, other, pairs)
        inverse, std = points.inverse.copy(), points.inverse_std.copy()
        inverse[here], std[here] = measured_ranges(points[here], other.rays[there], std_rad, pose, other.centre)
        points = replace(points, inverse=inverse, inverse_std=std)
    return points


def fit(
    config: PictureLoopConfig, earlier: KeyPicture, later: KeyPicture, points: RangedRays, near: tuple[float, float]
) -> PictureFit | None:
    """Where the later picture was taken, seen from the earlier one, which has these ``points``; else None.

    Args:
        near: the turn between them that is expected, and how far from it it may be (rad).
    """
    pairs = matches(earlier, later, config.ratio)
    if len(pairs) < config.least_inliers:
        return None
    seen, std_rad = later.rays[pairs[:, 1]], _deviations(earlier, later, pairs)
    found = ransac(earlier.rays[pairs[:, 0]], seen, 3.0 * std_rad, config.samples, near)
    if found is None or found[1].sum() < max(config.least_inliers, config.least_share * len(pairs)):
        return None
    (yaw, direction), agree = found
    points, seen, std_rad = points[pairs[agree, 0]], seen[agree], std_rad[agree]
    ranged = points.known
    if ranged.sum() < config.least_ranged:
        return None
    start = _begun(points[ranged], seen[ranged], std_rad[ranged], yaw, direction, later.centre)
    prior = start, np.linalg.inv(_ANYWHERE)
    fitted = fit_view(points, seen, std_rad, later.centre, start, prior, config.scale_std, config.rise_std)
    inliers = int(fitted.inlier.sum())
    if inliers < config.least_inliers or fitted.inlier[ranged].mean() < config.ranged_share:
        return None
    floor = np.diag((config.least_m**2, config.least_m**2, config.least_rad**2))
    covariance = config.std_factor**2 * fitted.covariance + floor
    if np.linalg.eigvalsh(covariance[:2, :2])[-1] > config.most_m**2 or covariance[2, 2] > config.most_rad**2:
        return None
    return PictureFit(fitted.pose, covariance, inliers)


def _deviations(first: KeyPicture, second: KeyPicture, pairs: np.ndarray) -> np.ndarray:
    """Of where matches ``(n, 2)`` are seen against each other ``(n,)``, rad."""
    return np.hypot(first.std_rad[pairs[:, 0]], second.std_rad[pairs[:, 1]])


def _begun(
    points: RangedRays, seen: np.ndarray, std_rad: np.ndarray, yaw: float, direction: float, centre: np.ndarray
) -> np.ndarray:
    """The pose ``(3,)`` of this yaw and this direction of the way, up to its sign, that suits the ranges best."""
    axis = np.array((np.cos(direction), np.sin(direction)))
    lever = se2.rotate(np.asarray(yaw), centre[:2]) - centre[:2]
    best, least = np.array((*-lever, yaw)), np.inf
    for way in np.concatenate((-_WAYS_M[:0:-1], _WAYS_M)):
        pose = np.array((*(way * axis - lever), yaw))
        errors = ray_errors(points, seen, pose, centre)[0]
        cost = float(np.log1p((errors**2).sum(1) / (3.0 * std_rad) ** 2).sum())
        if cost < least:
            best, least = pose, cost
    return best
