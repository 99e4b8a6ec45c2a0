"""Odometry of a calibrated camera on a robot whose motion is given roughly, by wheels or by the floor: no training.

Corners are followed from picture to picture. Each has a range, which grows sure while the robot moves. A picture's pose
is fitted to all of them at once, with the given motion as a prior (``geometry/view_pose.py``): heading and direction of
motion come from the picture, and the scale from the given motion, which ranges remember. Where pictures tell nothing,
the given motion counts alone. Without wheels corners on the floor give it (``geometry/floor_way.py``).
"""

import math
from dataclasses import replace

import numpy as np

from ngo_estimator.frontend.camera.camera_config import CameraConfig
from ngo_estimator.frontend.camera.feature_tracks import Grey, corners, followed, repeated, spread_corners
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.camera_model import CameraModel
from ngo_estimator.geometry.floor_way import BELOW, floor_way
from ngo_estimator.geometry.planar_motion import between, compose, turned_covariance, wrap
from ngo_estimator.geometry.planar_views import ransac
from ngo_estimator.geometry.view_pose import (
    INVERSE,
    UNKNOWN_STD,
    RangedRays,
    ViewPose,
    base_vectors,
    camera_at,
    fit_view,
    measured_ranges,
    unmeasured,
)

Array = np.ndarray

_NEAREST = 1e-3
"""Share of its range to which a point may come near."""

_AGREEING = 0.5
"""Where fewer corners than this agree with the given motion, another one is looked for."""

_FAR_MORE = 2.0
_RANSAC_SAMPLES, _RANSAC_PX = 60, 2.0
_MOST_SURPRISE = 4.0
"""Deviations of the given motion beyond which a fit is taken to have failed."""

_OFF = 2.0
"""Deviations of the heading by which corners are also looked for elsewhere."""

_SURE_SHARE = 0.3
"""Where fewer of the corners that agree do not repeat, a picture is no surer than what was given."""

_HELD = 100.0

_VARIANCES = np.array((1e-8, 1e-8, 1e-9))


class TrackedOdometry:
    """Poses of frames from pictures and the given motion between them.

    Args:
        by_floor: the motion that is given is a guess; corners on the floor tell a better one.
    """

    def __init__(self, model: CameraModel, config: CameraConfig, by_floor: bool = False) -> None:
        self._model, self._config, self._by_floor = model, config, by_floor
        rows = np.arange(model.height, dtype=np.float64)
        ahead = model.rays(np.column_stack((np.full(model.height, 0.5 * model.width), rows)))
        self._horizon_row = int((ahead[:, 2] > -BELOW).sum())
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next picture."""
        self.pose = np.zeros(3)
        """Of the newest frame ``(3,)``, in ``odom``."""
        self.inliers = 0
        """Corners that agreed with the newest pose."""
        self.floor_seen = self.scaled = False
        """Whether the newest picture showed enough of the floor, and whether that or ranges gave its motion a scale."""
        self._centre_now = self._model.centre.copy()  # of the camera, as the floor rises
        self._grey: Grey | None = None
        self._pixels = np.zeros((0, 2))
        self._points = RangedRays(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        self._sure = np.zeros(0, bool)  # which were found where they are, wherever one begins to look
        self._begin_step()

    @property
    def points(self) -> Array:
        """What the corners show whose ranges are known ``(n, 3)``, in base axes at the newest frame."""
        points = self._points[self._points.known]
        seen = base_vectors(points, self.pose, self._centre_now) / points.inverse[:, None]
        return seen + (*self._model.centre[:2], self._centre_now[2])

    def _begin_step(self) -> None:
        """Measure from the newest frame on."""
        self._centre = self._centre_now
        self._from = self.pose
        self._from_rays = self._model.rays(self._pixels)
        self._given = np.zeros(3)  # since then
        self._way = self._turn = self._frames = 0.0
        self._unknown = np.zeros(3)
        self._covariance = np.zeros((3, 3))

    def add(self, grey: Grey, given: Array, unknown: Array) -> tuple[Array, Array]:
        """Take the next picture and the motion ``(3,)`` that led to it, as it was given.

        Args:
            unknown: variances ``(3,)`` of what is open of that motion besides what the settings say (m, m, rad).

        Returns:
            The motion ``(3,)`` as it is estimated, and its covariance ``(3, 3)``.
        """
        if self._grey is None:
            self._grey = grey
            self._look_for_corners(grey)
            self._begin_step()
            return np.zeros(3), np.diag(_VARIANCES)
        before = self.pose
        self._given = compose(between(self._from, before) if self._by_floor else self._given, given)
        self._way += math.hypot(given[0], given[1])
        self._turn += abs(given[2])
        self._frames += 1
        self._unknown = self._unknown + unknown
        self._follow(grey, compose(before, given))
        if self._by_floor:  # the guess goes on from the pose before it, which is as unsure as it is
            self._unknown = np.diag(self._covariance) + unknown
        fitted = self._fit(compose(before, given))
        if self._by_floor:
            fitted = self._scaled_by_floor(fitted)
        self._take(fitted)
        relative = between(before, self.pose)
        covariance = self._step_covariance(relative, turned_covariance(-self._from[2], fitted.covariance))
        self._grey = grey
        if self._is_due():
            self._measure_ranges(fitted)
            self._look_for_corners(grey)
            self._begin_step()
        return relative, covariance

    def _follow(self, grey: Grey, predicted: Array) -> None:
        """Find the corners in the next picture."""
        assert self._grey is not None
        guess, ahead = self._model.pixels(base_vectors(self._points, predicted, self._centre_now))
        size = grey.shape[::-1]
        near = ahead & (guess > 0.0).all(1) & (guess < size).all(1)
        at, found, residual = followed(self._grey, grey, self._pixels, np.where(near[:, None], guess, self._pixels))
        given = between(self.pose, predicted)
        std = math.sqrt(self._turn_variance(math.hypot(given[0], given[1]), abs(given[2]), 1))
        turned, _ = self._model.pixels(base_vectors(self._points, predicted + (0.0, 0.0, _OFF * std), self._centre_now))
        either_way = np.where(np.arange(len(at)) % 2, 1.0, -1.0)[:, None]
        elsewhere = self._pixels + either_way * np.where(near[:, None], turned - guess, 0.0)
        self._sure = ~repeated(self._grey, grey, self._pixels, at, elsewhere, residual)[found & near]
        self._keep(found & near, at)

    def _scaled_by_floor(self, fitted: ViewPose) -> ViewPose:
        """The pose with the way that the floor tells, else with that of ranges, else as unsure as the guess."""
        if self._measure_way(fitted.pose):
            fitted = self._fit(fitted.pose)
        ranged = (fitted.inlier & self._points.known).sum() >= self._config.least_inliers
        self.scaled = self.floor_seen or (self.scaled and bool(ranged))
        wide = _not_surer(fitted.covariance, self._prior[1])
        return fitted if self.scaled else replace(fitted, covariance=wide)

    def _measure_way(self, pose: Array) -> bool:
        """Whether the floor tells how far the newest picture is from the last step, in the direction of a ``pose``
        ``(3,)``; then that motion is given. While few ranges are known the direction is that of two views alone."""
        config, seen, moved = self._config, self._model.rays(self._pixels), between(self._from, pose)
        way, yaw = self._camera_way(moved), moved[2]
        if self._points.known.sum() < config.least_inliers:
            found = ransac(self._from_rays, seen, _RANSAC_PX * self._model.pixel_rad, _RANSAC_SAMPLES)
            if found is not None:
                yaw, direction = found[0]
                way = np.array((math.cos(direction), math.sin(direction)))
        axis = way / max(float(np.linalg.norm(way)), 1e-9)
        std_rad = self._deviations(seen, pose, config.range_pixel_std)
        length = floor_way(self._from_rays, seen, std_rad, self._model.centre[2], yaw, axis, config.least_inliers,
                           config.floor_share)  # fmt: skip
        self.floor_seen = length is not None
        if length is not None:
            self._given, self._unknown = self._moved(length * axis, yaw), np.zeros(3)
        return self.floor_seen

    def _turn_variance(self, way: float, turn: float, frames: float) -> float:
        """Of the given heading, after a way (m) and a turn (rad) in so many frames."""
        config = self._config
        share, drift = config.given_turn_share * turn, config.given_rad_per_m * way
        return share**2 + drift**2 + frames * config.given_rad**2

    def _keep(self, which: np.ndarray, pixels: Array) -> None:
        self._pixels, self._points, self._from_rays = pixels[which], self._points[which], self._from_rays[which]

    @property
    def _prior(self) -> tuple[Array, Array]:
        """The given motion since the last step: a pose ``(3,)``, and its covariance ``(3, 3)``."""
        config = self._config
        along = (config.given_way_share * self._way) ** 2 + self._frames * config.given_m**2
        turn = self._turn_variance(self._way, self._turn, self._frames)
        covariance = np.diag((along, along, turn) + self._unknown)
        return compose(self._from, self._given), covariance

    @property
    def _rise_std(self) -> float:
        return self._config.rise_m + self._config.rise_share * self._way

    def _fit(self, predicted: Array) -> ViewPose:
        """The newest pose from what is seen."""
        mean, covariance = self._prior
        alone = ViewPose(mean, covariance, np.zeros(len(self._points), bool))
        if len(self._points) < self._config.least_inliers:
            return alone
        seen = self._model.rays(self._pixels)
        std_rad = self._deviations(seen, predicted, self._config.pixel_std)
        information = np.linalg.inv(covariance)

        def fit(start: Array, held: Array) -> ViewPose:
            config, prior = self._config, (mean, held)
            found = fit_view(self._points, seen, std_rad, self._centre, start, prior, config.scale_std, self._rise_std)
            wide = config.std_factor**2 * found.covariance
            return replace(found, covariance=_surer(wide, covariance))  # no less sure than what was given

        fitted = fit(predicted, information)
        if fitted.inlier.mean() < _AGREEING:
            other = self._without_prior(seen, mean)
            if other is not None:
                fitted = _likelier(fitted, fit(other, information))
        off = np.append(fitted.pose[:2] - mean[:2], wrap(fitted.pose[2] - mean[2]))
        if off[:2] @ information[:2, :2] @ off[:2] > _MOST_SURPRISE**2:
            # Few near points may tell any way: then the given one counts, and pictures tell the heading alone.
            held = np.diag((_HELD, _HELD, 1.0)) @ information
            fitted = fit(mean, held)
            fitted = replace(fitted, covariance=_not_surer(fitted.covariance, covariance), scale=0.0)
            off[2] = wrap(fitted.pose[2] - mean[2])
        self._seen = seen
        trusted = (
            fitted.inlier.sum() >= self._config.least_inliers and off[2] ** 2 < _MOST_SURPRISE**2 * covariance[2, 2]
        )
        if not trusted:
            return alone
        sure = (fitted.inlier & self._sure).sum() >= _SURE_SHARE * fitted.inlier.sum()
        return fitted if sure else replace(fitted, covariance=covariance)

    def _deviations(self, seen: Array, predicted: Array, pixel_std: float) -> Array:
        """Of rays ``(n,)``, rad: corners that moved far against what is far away are followed worse."""
        parallax = np.linalg.norm(seen - self._from_rays @ _turn(predicted[2] - self._from[2]), axis=1)
        deviations: Array = np.hypot(pixel_std * self._model.pixel_rad, self._config.parallax_std * parallax)
        return deviations

    def _without_prior(self, seen: Array, mean: Array) -> Array | None:
        """A pose ``(3,)`` on which most rays agree, as far away as was given."""
        found = ransac(self._from_rays, seen, _RANSAC_PX * self._model.pixel_rad, _RANSAC_SAMPLES)
        if found is None:
            return None
        yaw, direction = found[0]
        moved = self._camera_way(between(self._from, mean))
        axis = np.array((math.cos(direction), math.sin(direction)))
        at = axis * np.linalg.norm(moved) * (1.0 if axis @ moved >= 0.0 else -1.0)
        return compose(self._from, self._moved(at, yaw))

    def _camera_way(self, motion: Array) -> Array:
        """The way of the camera ``(2,)`` when the robot moves ``(3,)``."""
        way: Array = (camera_at(motion, self._model.centre) - self._model.centre)[:2]
        return way

    def _moved(self, way: Array, yaw: float) -> Array:
        """The motion ``(3,)`` of a robot that turns, whose camera goes a way ``(2,)``."""
        return np.append(way - self._camera_way(np.array((0.0, 0.0, yaw))), yaw)

    def _take(self, fitted: ViewPose) -> None:
        self.pose, self.inliers = fitted.pose, int(fitted.inlier.sum())
        self._centre_now = self._centre + (0.0, 0.0, fitted.rise)

    def _step_covariance(self, relative: Array, since: Array) -> Array:
        """Covariance ``(3, 3)`` of the newest step: what it adds to that of the pose since the last measurement.

        Args:
            since: ``(3, 3)`` of the newest pose, seen from there.
        """
        so_far = between(self._from, self.pose)
        yaw = so_far[2] - relative[2]
        lever = np.eye(3)
        lever[:2, 2] = se2.rotate(np.asarray(yaw), np.array((-relative[1], relative[0])))
        added = turned_covariance(-yaw, since - lever @ self._covariance @ lever.T)
        self._covariance = since
        values, vectors = np.linalg.eigh(0.5 * (added + added.T))
        positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
        return positive + np.diag(_VARIANCES)

    def _is_due(self) -> bool:
        """Whether ranges are to be measured, and corners to be looked for."""
        config, moved = self._config, between(self._from, self.pose)
        far = math.hypot(moved[0], moved[1]) > config.step_m or abs(moved[2]) > config.step_rad
        return far or self.inliers < config.left_share * config.corners

    def _measure_ranges(self, fitted: ViewPose) -> None:
        """Make ranges surer by what the newest picture shows of them; corners that do not agree are given up."""
        if not fitted.inlier.any():
            self._keep(np.zeros(len(self._points), bool), self._pixels)
            return
        points, here = self._points, camera_at(fitted.pose, self._centre_now)
        scaled = replace(points, inverse=points.inverse * (1.0 + fitted.scale))
        unknown_m = math.sqrt(np.trace(fitted.covariance[:2, :2])) if self._unknown.any() else 0.0
        std_rad = np.full(len(points), self._config.range_pixel_std * self._model.pixel_rad)
        inverse, std = measured_ranges(scaled, self._seen, std_rad, fitted.pose, self._centre_now, unknown_m)
        # From now on they are seen from here.
        vectors = points.rays + inverse[:, None] * (points.origins - here)
        nearer = 1.0 / np.maximum(np.linalg.norm(vectors, axis=1), _NEAREST)
        std = np.minimum(std * nearer**2, UNKNOWN_STD)
        origins, rays = np.tile(here, (len(std), 1)), self._seen @ _turn(fitted.pose[2]).T
        self._points = RangedRays(origins, rays, inverse * nearer, std)
        self._keep(fitted.inlier, self._pixels)

    def _look_for_corners(self, grey: Grey) -> None:
        config = self._config
        apart_px = config.apart * self._model.width
        fresh = np.zeros((0, 2))
        if self._by_floor:
            fresh = spread_corners(grey, self._horizon_row, apart_px, self._pixels)
        taken = np.concatenate((self._pixels, fresh))
        fresh = np.concatenate((fresh, corners(grey, config.corners - len(taken), apart_px, taken)))
        rays = self._model.rays(fresh) @ _turn(self.pose[2]).T
        known = self._points.inverse[self._points.inverse_std < 0.2 * self._points.inverse]
        inverse = float(np.clip(np.median(known), 0.05, 2.0)) if len(known) > 10 else INVERSE
        new = unmeasured(camera_at(self.pose, self._centre_now), rays, inverse)
        self._points = self._points.extended(new)
        self._pixels = np.concatenate((self._pixels, fresh))


def _turn(yaw: float) -> Array:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))


def _likelier(near: ViewPose, far: ViewPose) -> ViewPose:
    """Of two poses that corners may mean the one near the given motion, unless far more agree with the other."""
    return far if far.inlier.sum() > _FAR_MORE * near.inlier.sum() else near


def _surer(one: Array, other: Array) -> Array:
    """The smaller of two covariances ``(3, 3)``, along the axes in which they differ."""
    lower = np.linalg.cholesky(other)
    inverse = np.linalg.inv(lower)
    values, vectors = np.linalg.eigh(inverse @ one @ inverse.T)
    half = lower @ vectors
    result: Array = (half * np.minimum(values, 1.0)) @ half.T
    return result


def _not_surer(one: Array, given: Array) -> Array:
    """A covariance ``(3, 3)`` whose position is no surer than the given one."""
    result = one.copy()
    result[:2] = result[:, :2] = 0.0
    result[:2, :2] = given[:2, :2]
    return result
