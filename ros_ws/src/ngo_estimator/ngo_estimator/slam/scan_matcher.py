"""Sightings by a lidar: a key scan searched in the key scans of a map, as the search for loops verifies one.

Where nothing is known, the newest scans are searched in the whole map, by branch and bound. A pose that fits is
verified in a submap of its place, with the tests of a loop.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.branch_and_bound import pooled_grid, search
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, compose, transformed, turned_covariance
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_fit import fit, search_points
from ngo_estimator.loops.scan_settings import ScanLoopConfig
from ngo_estimator.loops.scan_submaps import SUBMAP_VARIANCE, ScanSubmaps, laid_together
from ngo_estimator.loops.walls_seen_through import PlacedScans, range_profile
from ngo_estimator.slam.sightings import Sightings

_MARGIN_M = 2.0  # around the key scans of the map, where the robot may be
_SEARCHED = 150  # points in the whole map; a pose that fits is verified with more of them
_SEARCHED_NEAR, _MOST_BLOCKS_NEAR = 60, 12_000  # the same near the key scans, and how many blocks are split at most
_LEAST_NEAR, _LEAST_SECOND_NEAR = 0.45, 0.75  # likelihoods that are distinguished there
_AROUND = np.array((1.0, 1.0, math.radians(15.0)))  # of a pose that is verified


class ScanMatcher:
    """Compares key scans with those of a map.

    Args:
        scans, poses: of the map's key scans, poses ``(keys, 3)``; scans without points say nothing.
        views: of these scans, or of the first of them.
        config: how a loop is searched and tested.
        reach_m: how far the robot is from one of the map's key scans at most. Anywhere, infinity, costs ten times more.
        borders: key scans from which on scans do not lie together with those before; None: all do.
    """

    place_m = 1.0
    search_every = 4

    def __init__(
        self,
        scans: Sequence[KeyScan],
        poses: np.ndarray,
        views: KeyScanViews,
        config: ScanLoopConfig,
        reach_m: float = math.inf,
        borders: np.ndarray | None = None,
    ) -> None:
        points = [transformed(pose, scan.points) for pose, scan in zip(poses, scans, strict=True)]
        if sum(map(len, points)) == 0:
            raise ValueError("no key scan of the map has a point; expected a map with walls")
        self._scans, self._poses, self._views = scans, poses, views.of_map(scans)
        self._config, self._borders = config, borders
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
        self._odometry: list[np.ndarray] = []

    def append(self, step: RelativeStep, odometry: np.ndarray) -> bool:
        """Take the next frame and its pose ``(3,)`` by odometry; only key scans are compared with the map."""
        if step.key is None:
            return False
        keep = self._config.source_keys
        self._recent = [*self._recent, step.key.scan][-keep:]
        self._odometry = [*self._odometry, odometry][-keep:]
        return len(self._recent) == keep

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

    def _source(self) -> PlacedScans:
        return laid_together(self._recent, [range_profile(scan) for scan in self._recent], np.stack(self._odometry))

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
        place = self._views.most_alike(self._poses, source.points, expected)
        submap = self._submaps.around(place, self._scans, self._views.profiles, self._poses, self._borders)
        found = fit(self._config, submap, source, between(self._poses[place], expected), _AROUND)
        if found is None:
            return None
        turned = turned_covariance(self._poses[place, 2], found.covariance + SUBMAP_VARIANCE)
        return compose(self._poses[place], found.pose), turned


def _one_a_cell(points: np.ndarray, cell_m: float) -> np.ndarray:
    """The first of the points ``(n, 2)`` in each cell."""
    _, first = np.unique(np.floor(points / cell_m).astype(np.int64) @ (1 << 32, 1), return_index=True)
    return points[np.sort(first)]
