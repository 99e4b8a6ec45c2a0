"""Sightings by a lidar: a key scan searched in the key scans of a map, as the search for loops verifies one.

Where nothing is known, the newest scans are searched in the whole map, by branch and bound. A pose that fits is
verified in a submap of its place, with the tests of a loop.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.branch_and_bound import pooled_grid, search
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, compose, transformed, turned_covariance
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.place_evidence import MOST_SCANS, NEAR_M, PlaceEvidence, evidence_at, last_stretch
from ngo_estimator.loops.scan_fit import fit, search_points
from ngo_estimator.loops.scan_settings import ScanLoopConfig
from ngo_estimator.loops.scan_submaps import SUBMAP_VARIANCE, ScanSubmaps, around_in_time, laid_together
from ngo_estimator.loops.walls_seen_through import PlacedScans, placed, range_profile
from ngo_estimator.slam.sightings import Sightings

_MARGIN_M = 2.0  # around the key scans of the map, where the robot may be
_SEARCHED = 150  # points in the whole map; a pose that fits is verified with more of them
_SEARCHED_NEAR, _MOST_BLOCKS_NEAR = 60, 12_000  # the same near the key scans, and how many blocks are split at most
_LEAST_NEAR, _LEAST_SECOND_NEAR = 0.45, 0.75  # likelihoods that are distinguished there
_AROUND = np.array((1.0, 1.0, math.radians(15.0)))  # of a pose that is verified
_MOST_RECENT = 64  # key scans of the way that are kept

REACH_M = 2.0
"""How far the robot is from where a robot was before, where it is found in a map that grows."""


class ScanMatcher:
    """Compares key scans with those of a map.

    Args:
        scans, poses: of the map's key scans, poses ``(keys, 3)``; scans without points say nothing.
        views: of these scans, or of the first of them.
        config: how a loop is searched and tested.
        reach_m: how far the robot is from one of the map's key scans at most. Anywhere, infinity, costs ten times more.
        parts: the part of the map that each key scan is in ``(keys,)``. Of a drive few may be left: those of one part
            that are around a place show it together. By default the map is one way.
    """

    place_m = 1.0
    look_m = 0.0  # key scans alone are compared, which are apart
    search_every = 8

    def __init__(
        self,
        scans: Sequence[KeyScan],
        poses: np.ndarray,
        views: KeyScanViews,
        config: ScanLoopConfig,
        reach_m: float = math.inf,
        parts: np.ndarray | None = None,
    ) -> None:
        points = [transformed(pose, scan.points) for pose, scan in zip(poses, scans, strict=True)]
        if sum(map(len, points)) == 0:
            raise ValueError("no key scan of the map has a point; expected a map with walls")
        self._scans, self._poses, self._views = scans, poses, views.of_map(scans)
        self._config, self._parts = config, parts
        self._submaps = ScanSubmaps(config)
        together = np.concatenate(points)
        if reach_m < math.inf:  # a map that grows is made again and again
            together = _one_a_cell(together, 0.5 * config.search.resolution_m)
        self._grid = pooled_grid(config.search, together)
        low, high = poses[:, :2].min(0) - _MARGIN_M, poses[:, :2].max(0) + _MARGIN_M
        self._centre = np.array((*(0.5 * (low + high)), 0.0))
        self._window = np.array((*(0.5 * (high - low)), math.pi))
        self._search, self._searched, self._near = config.search, _SEARCHED, None
        if reach_m < math.inf:
            self._search = replace(
                config.search,
                most_blocks=_MOST_BLOCKS_NEAR,
                least_response=_LEAST_NEAR,
                least_second=_LEAST_SECOND_NEAR,
            )
            self._searched, self._near = _SEARCHED_NEAR, (poses[:, :2], reach_m)
        self.reset()

    def reset(self) -> None:
        """Forget all scans but those of the map."""
        self._recent: list[KeyScan] = []
        self._profiles: list[np.ndarray] = []
        self._odometry: list[np.ndarray] = []

    def append(self, step: RelativeStep, odometry: np.ndarray) -> bool:
        """Take the next frame and its pose ``(3,)`` by odometry; only key scans are compared with the map."""
        if step.key is None:
            return False
        self._recent = [*self._recent, step.key.scan][-_MOST_RECENT:]
        self._profiles = [*self._profiles, range_profile(step.key.scan)][-_MOST_RECENT:]
        self._odometry = [*self._odometry, odometry][-_MOST_RECENT:]
        return True

    def everywhere(self) -> Sightings:
        """Hypotheses of the newest frame's pose, wherever it may be: the best one, and the best well apart from it."""
        return self.search(self._source())

    def search(self, source: PlacedScans) -> Sightings:
        """The same of a source's pose."""
        points = search_points(self._config, source)
        points = points[:: max(1, round(len(points) / self._searched))]
        if len(points) == 0:
            return Sightings.none()
        match = search(self._search, self._grid, points, self._centre, self._window, self._near)
        if match is None:
            return Sightings.none()
        others = () if match.second_pose is None else (match.second_pose,)
        return self._verified(source, (match.pose, *others))

    def around(self, expected: np.ndarray) -> Sightings:
        """Hypotheses of the newest frame's pose, which should be near ``expected`` ``(3,)``."""
        return self._verified(self._source(), (expected,))

    def is_clear(self, pose: np.ndarray) -> bool:
        """Whether one sighting is enough for a pose: by the walls that the way and the map have in common there."""
        return self._evidence(pose).is_clear

    def allows(self, pose: np.ndarray) -> bool:
        """Whether many sightings are enough: the way and the map agree there."""
        return self._evidence(pose).suffices

    def _evidence(self, pose: np.ndarray) -> PlaceEvidence:
        """How the last stretch of the way agrees with the map, where the newest frame is at ``pose`` ``(3,)``."""
        odometry = np.stack(self._odometry)
        stretch = last_stretch(odometry, 0)
        at = se2.compose(pose, se2.between(odometry[-1], odometry[stretch]))
        scans, profiles = self._recent[int(stretch[0]) :], self._profiles[int(stretch[0]) :]

        def part(which: slice) -> PlacedScans:
            return placed(scans[which], profiles[which], at[which])

        return evidence_at(
            self._scans, self._views, (at, part), (np.arange(len(self._scans)), self._poses), count_walls=True
        )

    def _source(self) -> PlacedScans:
        newest = slice(-self._config.source_keys, None)
        return laid_together(self._recent[newest], self._profiles[newest], np.stack(self._odometry[newest]))

    def _verified(self, source: PlacedScans, poses: Sequence[np.ndarray]) -> Sightings:
        seen = [self._seen(source, pose) for pose in poses]
        found = [one for one in seen if one is not None]
        if not found:
            return Sightings.none()
        at, covariance = (np.stack(column) for column in zip(*found, strict=True))
        return Sightings(at, covariance, np.ones(len(found)))

    def _seen(self, source: PlacedScans, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Pose ``(3,)`` of a source near an expected one, and its covariance ``(3, 3)``; None where a test fails.

        The tests are those of a loop, but for neighbours and the graph's pose.
        """
        place = int(self._views.most_alike(self._poses, source.points, expected)[0])
        there = around_in_time(place, len(self._scans), self._config.submap_keys)
        if self._parts is not None:
            alike = self._views.most_alike(self._poses, self._scans[place].points, self._poses[place])
            near = np.linalg.norm(self._poses[alike, :2] - self._poses[place, :2], axis=1) < NEAR_M
            there = np.sort(alike[near & (self._parts[alike] == self._parts[place])][:MOST_SCANS])
        submap = self._submaps.around(place, there, self._scans, self._views.profiles, self._poses)
        found = fit(self._config, submap, source, between(self._poses[place], expected), _AROUND)
        if found is None:
            return None
        registered, _ = found
        turned = turned_covariance(self._poses[place, 2], registered.covariance + SUBMAP_VARIANCE)
        return compose(self._poses[place], registered.pose), turned


def _one_a_cell(points: np.ndarray, cell_m: float) -> np.ndarray:
    """The first of the points ``(n, 2)`` in each cell."""
    _, first = np.unique(np.floor(points / cell_m).astype(np.int64) @ (1 << 32, 1), return_index=True)
    return points[np.sort(first)]
