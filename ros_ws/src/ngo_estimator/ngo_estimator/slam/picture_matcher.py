"""Sightings by a calibrated camera: a key picture compared with those of a map, as a loop is verified."""

import math

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.key_picture import KeyPicture, nothing_seen
from ngo_estimator.geometry.planar_motion import compose, turned_covariance, wrap
from ngo_estimator.graph.pose_graph import PoseGraph
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
        graph: whose nodes they are; poses: of these in ``map`` ``(keys, 3)``.
    """

    place_m = 2.0
    look_m = 0.0  # key pictures alone are compared, which are apart
    search_every = 1

    def __init__(self, finder: PictureLoopFinder, graph: PoseGraph, poses: np.ndarray) -> None:
        if len(finder.alike(nothing_seen())) == 0:
            least = finder.config.vocabulary_pictures
            raise ValueError(f"the map has {len(finder)} key pictures; expected {least} or more, with features")
        self._finder, self._graph, self._poses = finder, graph, poses
        self.reset()

    def reset(self) -> None:
        """Forget the newest picture."""
        self._newest = nothing_seen()

    def append(self, step: RelativeStep, odometry: np.ndarray) -> bool:
        """Take the next frame; only a key picture is compared."""
        if is_key := len(step.place_code) > 0:
            self._newest = KeyPicture.unpacked(step.place_code)
        return is_key

    def everywhere(self) -> Sightings:
        """Hypotheses of the newest frame's pose, wherever it may be: at most one of each place."""
        return self._seen_from(np.ones(len(self._poses), np.bool_), self.place_m, None)

    def around(self, expected: np.ndarray) -> Sightings:
        """Hypotheses of the newest frame's pose, which should be near ``expected`` ``(3,)``."""
        away = np.linalg.norm(self._poses[:, :2] - expected[:2], axis=1)
        return self._seen_from(away < self._finder.config.apart_m, 0.0, float(expected[2]))

    def _seen_from(self, which: np.ndarray, apart_m: float, yaw: float | None) -> Sightings:
        """What the key pictures that look most alike among ``which`` ``(keys,)`` say, each so far from the others.

        ``yaw`` is the newest one's, where known.
        """
        found, finder = Sightings.none(), self._finder
        alike = np.where(which, finder.alike(self._newest), -np.inf)
        for _ in range(finder.config.candidates):
            node = int(alike.argmax())
            if alike[node] == -np.inf:
                break
            pose = self._poses[node]
            near = (0.0, math.pi) if yaw is None else (wrap(yaw - pose[2]), _TURN_RAD)
            fitted = finder.fitted(node, self._newest, self._graph, near)
            alike[np.linalg.norm(self._poses[:, :2] - pose[:2], axis=1) <= apart_m] = -np.inf
            if fitted is not None:
                covariance = turned_covariance(pose[2], fitted.covariance)[None]
                one = Sightings(compose(pose, fitted.relative)[None], covariance, np.array((_BELIEF,)))
                found = found.and_also(one)
        return found
