"""Finds loops of key pictures without training: what looks alike near where the robot may be, verified by geometry."""

import math

import numpy as np

from ngo_estimator.data.state_arrays import Arrays, flat, part, require, restore, split, state_of, under
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_picture import KeyPicture, nothing_seen
from ngo_estimator.geometry.planar_motion import turned_covariance
from ngo_estimator.geometry.view_pose import RangedRays
from ngo_estimator.graph.loop_evidence import likelihood_ratio, map_area
from ngo_estimator.graph.path_covariance import path_covariances
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.graph.relative_poses import BELIEVED
from ngo_estimator.graph.segments import segment_of
from ngo_estimator.loops.picture_fit import PictureFit, fit, points_of
from ngo_estimator.loops.picture_loops import PictureLoops
from ngo_estimator.loops.picture_places import PicturePlaces
from ngo_estimator.loops.picture_settings import PictureLoopConfig

_NEIGHBOURS = np.array((-2, -1, 1, 2))


class PictureLoopFinder:
    """Finds loops of each new key picture, and keeps those that were verified; a robust corrector judges them."""

    def __init__(self, config: PictureLoopConfig) -> None:
        self.config = config
        self.loops = PictureLoops.none()
        self._pictures: list[KeyPicture] = []
        self._places = PicturePlaces(config.words, config.vocabulary_pictures, config.most_pictures)
        self._points: dict[int, RangedRays] = {}

    def __len__(self) -> int:
        return len(self._pictures)

    def append(self, picture: KeyPicture) -> None:
        """Take the key picture of the next node."""
        self._pictures.append(picture)
        self._places.append(self._pictures)
        if (old := len(self._pictures) - 1 - self.config.most_pictures) >= 0:
            self._pictures[old] = nothing_seen()
            self._points.pop(old, None)

    def find(self, graph: PoseGraph, belief: np.ndarray) -> int:
        """Look for loops of the last node; returns how many were found.

        ``belief`` ``(n,)`` is in the first loops, with which the graph was solved: only believed ones make it surer.
        """
        node, found = len(self._pictures) - 1, PictureLoops.none()
        others, covariances = self._candidates(graph, self.loops[np.flatnonzero(belief > BELIEVED)])
        for other, covariance in zip(others.tolist(), covariances, strict=True):
            turn = float(se2.wrap(graph.poses[node, 2] - graph.poses[other, 2]))
            near = turn, self.config.turn_rad + self.config.deviations * float(np.sqrt(covariance[2, 2]))
            fitted = self.fitted(other, self._pictures[node], graph, near)
            if fitted is None or not self._expected(fitted, graph.poses, (other, node), covariance):
                continue
            pair, inliers = np.array(((other, node),)), np.array((fitted.inliers,))
            found = found.extended(PictureLoops(pair, fitted.relative[None], fitted.covariance[None], inliers))
        self.loops = self.loops.extended(found)
        return len(found)

    def alike(self, picture: KeyPicture) -> np.ndarray:
        """How alike a picture is to each node's ``(n,)``; those that are not compared have -inf."""
        return self._places.alike(picture)

    def fitted(self, node: int, picture: KeyPicture, graph: PoseGraph, near: tuple[float, float]) -> PictureFit | None:
        """Where a picture was taken, seen from a node; see ``picture_fit.fit``."""
        return fit(self.config, self._pictures[node], picture, self._points_of(node, graph), near)

    def _expected(self, fitted: PictureFit, poses: np.ndarray, pair: tuple[int, int], covariance: np.ndarray) -> bool:
        """Whether a fit of a pair of nodes is where their poses, among all ``(nodes, 3)``, put it.

        Another place that looks alike may be anywhere on the map. The less the graph knows, the likelier it is within
        the graph's deviations by chance.
        """
        config, (start, end) = self.config, pair
        off = se2.wrapped(fitted.relative - se2.between(poses[start], poses[end]))
        known = turned_covariance(-poses[start, 2], covariance) + fitted.covariance
        squared, log = np.array(off @ np.linalg.solve(known, off)), np.array(np.linalg.slogdet(known)[1])
        likelier = likelihood_ratio(squared, log, np.array(3), map_area(poses))
        return bool(squared <= config.deviations**2 and likelier >= math.log(config.likelier))

    def _candidates(self, graph: PoseGraph, closed: PictureLoops) -> tuple[np.ndarray, np.ndarray]:
        """Earlier nodes ``(n,)`` that look most alike, among those that may be near.

        Also the covariances ``(n, 3, 3)`` with which the graph, and the loops that it ``closed``, know the last node
        against them, along the map's axes.
        """
        config, node = self.config, len(self._pictures) - 1
        older = self.alike(self._pictures[node])[: max(0, node - config.recent)]
        ranked = np.argsort(-older, kind="stable")[: config.looked_at]
        ranked = ranked[np.isfinite(older[ranked])]
        if len(ranked) == 0:
            return ranked, np.zeros((0, 3, 3))
        pairs = np.stack((ranked, np.full(len(ranked), node)), axis=1)
        covariance = path_covariances(
            graph.poses,
            np.concatenate((graph.edges, closed.pairs)),
            np.concatenate((graph.step_covariance, closed.covariance)),
            pairs,
        )
        away = np.linalg.norm(graph.poses[ranked, :2] - graph.poses[node, :2], axis=1)
        doubt = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1])
        near = np.flatnonzero(away < config.apart_m + config.deviations * doubt)[: config.candidates]
        return ranked[near], covariance[near]

    def _points_of(self, node: int, graph: PoseGraph) -> RangedRays:
        """Features of a node's picture with ranges, by the pictures of its neighbours in the same odometry."""
        if node not in self._points:
            odometry, poses = segment_of(graph.frames.joins, graph.frames.nodes), graph.poses
            near = node + _NEIGHBOURS
            near = near[(near >= 0) & (near < len(self._pictures))]
            near = near[odometry[near] == odometry[node]].tolist()
            others = [(self._pictures[other], se2.between(poses[node], poses[other])) for other in near]
            self._points[node] = points_of(self._pictures[node], others, self.config)
        return self._points[node]

    def drop(self, chosen: np.ndarray) -> int:
        """See ``LoopFinder.drop``."""
        self.loops = self.loops[~chosen]
        return int(chosen.sum())

    def state(self) -> Arrays:
        """All that later loops depend on, for ``restore``."""
        codes = flat([picture.packed() for picture in self._pictures], np.zeros(0, np.float32))
        return {**under("pictures", codes), **self._places.state(), **under("loops", state_of(self.loops))}

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()``; raises ``StateError``, or ``ValueError`` about a picture that is none."""
        codes = split(part(arrays, "pictures"), np.float32)
        self._pictures = [KeyPicture.unpacked(code) for code in codes]
        self._places.restore(arrays)
        self._places.rebuild(self._pictures)
        self.loops = restore(self.loops, part(arrays, "loops"))
        pairs = self.loops.pairs
        require(
            bool(((pairs >= 0) & (pairs < len(self._pictures))).all()), "a loop joins key pictures that are not there"
        )
