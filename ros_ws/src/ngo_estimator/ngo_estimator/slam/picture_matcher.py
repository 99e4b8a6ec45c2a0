"""Sightings by a calibrated camera: a key picture compared with those of a map, as a loop is verified."""

import math

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.key_picture import KeyPicture
from ngo_estimator.geometry.planar_motion import compose, turned_covariance, wrap
from ngo_estimator.loops.picture_loop_finder import PictureLoopFinder
from ngo_estimator.slam.sightings import Sightings, SightingsAlone

_BELIEF = 0.9
"""In a fit that geometry verified: another place may look alike."""

_TURN_RAD = 0.3
"""By which the newest picture may be turned against what is expected."""


class PictureMatcher(SightingsAlone):
    """Compares key pictures with those of a map.

    Args:
        finder: has the key pictures of the map, and verifies pairs of them.
        poses: of these ``(keys, 3)``.
    """

    def __init__(self, finder: PictureLoopFinder, poses: np.ndarray) -> None:
        self.search_every, self.place_m, self.look_m = 1, 2.0, 0.8
        self._finder, self._poses = finder, poses
        self.reset()

    def reset(self) -> None:
        """Forget the newest picture."""
        self._newest: KeyPicture | None = None

    def append(self, step: RelativeStep, odometry: np.ndarray) -> bool:
        """Take the next frame; only a key picture is compared."""
        self._newest = KeyPicture.unpacked(step.place_code) if len(step.place_code) else None
        return self._newest is not None

    def everywhere(self) -> Sightings:
        """Hypotheses of the newest frame's pose, wherever it may be."""
        return self._seen_from(np.arange(len(self._poses)), None)

    def around(self, expected: np.ndarray) -> Sightings:
        """Hypotheses of the newest frame's pose, which should be near ``expected`` ``(3,)``."""
        away = np.linalg.norm(self._poses[:, :2] - expected[:2], axis=1)
        return self._seen_from(np.flatnonzero(away < self._finder.config.apart_m), float(expected[2]))

    def _seen_from(self, nodes: np.ndarray, yaw: float | None) -> Sightings:
        """What the key pictures that look most alike among ``nodes`` say; ``yaw`` is the newest one's, where known."""
        found, finder = Sightings.none(), self._finder
        if self._newest is None or len(alike := finder.alike(self._newest)) == 0:
            return found
        ranked = nodes[np.argsort(-alike[nodes], kind="stable")][: finder.config.candidates]
        for node in ranked[np.isfinite(alike[ranked])].tolist():
            pose = self._poses[node]
            near = (0.0, math.pi) if yaw is None else (wrap(yaw - pose[2]), _TURN_RAD)
            fitted = finder.fitted(node, self._newest, self._poses, near)
            if fitted is not None:
                covariance = turned_covariance(pose[2], fitted.covariance)[None]
                one = Sightings(compose(pose, fitted.relative)[None], covariance, np.array((_BELIEF,)))
                found = found.and_also(one)
        return found
