"""Finds loops of 2D lidar key scans, verified without learning, and selects those that a graph uses.

A new key asks for loops with earlier keys near which the robot may be. Its scan and the scans of the
keys before it are searched in a submap of an earlier key. A loop is accepted where they fit, near the graph's pose, and
a neighbouring loop agrees. No loop is better than a wrong one. The graph uses those that it may believe and needs.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, turned_covariance, wrap
from ngo_estimator.graph.path_covariance import path_covariances
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.sparsification import WALLS_M, largest_variances, needed_loops
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_fit import fit
from ngo_estimator.loops.scan_loop_agreement import with_agreement
from ngo_estimator.loops.scan_loop_candidates import covariance_windows, loop_candidates
from ngo_estimator.loops.scan_loops import ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.loops.scan_submaps import SUBMAP_VARIANCE, ScanSubmaps, around_in_time, laid_together


class ScanLoopFinder:
    """Finds loops of each new key, keeps all that were verified, and selects those that the graph uses."""

    def __init__(self, config: ScanGraphConfig) -> None:
        self.config = config
        self.loops = ScanLoops.none()
        self.views = KeyScanViews()
        """Of all key scans that ``find`` has seen."""
        self._submaps = ScanSubmaps(config.loops)
        self.doubted = np.zeros(0, np.int64)
        """Accepted loops for which too few speak as yet."""
        self._used = GrowingRows((), np.int64)

    def find(
        self,
        scans: Sequence[KeyScan],
        poses: np.ndarray,
        windows: np.ndarray,
        segments: np.ndarray | None = None,
        begin: int = 0,
    ) -> np.ndarray:
        """Loops of the last key, under the present poses.

        Args:
            scans: of all keys, in their order; each call has one more than the call before, or more.
            poses: of all keys in the map ``(keys, 3)``.
            windows: half widths of the search around each key's pose, as seen from the last ``(keys, 3)`` (m, m, rad).
            segments: keys from which on scans do not lie together with those before; None: all do.
            begin: the key from which on keys are counted: of some no loops are looked for.

        Returns:
            Which of ``loops`` ``(n,)`` this call made acceptable, the last key's and earlier ones with which they
            agree.
        """
        count, config = len(scans), self.config.loops
        if poses.shape != (count, 3) or windows.shape != (count, 3):
            raise ValueError(
                f"poses, windows have the shapes {poses.shape}, {windows.shape} for {count} scans; expected (keys, 3)"
            )
        self._see(scans)
        if (count - 1 - begin) % config.every:
            return np.zeros(0, np.int64)
        if not (windows > 0.0).all():
            raise ValueError(f"the narrowest of the windows is {windows.min()}; expected positive half widths")
        if segments is not None and count - segments[-1] < config.source_keys:
            return np.zeros(0, np.int64)  # scans of two segments do not lie together
        loops = self.loops
        for place in loop_candidates(config, self.views, poses, windows):
            loop = self._verified(scans, poses, place, windows[place], segments)
            if loop is not None:
                loops = loops.extended(loop)
        if len(loops) == len(self.loops):
            return np.zeros(0, np.int64)
        self.loops = with_agreement(config, loops, len(self.loops), poses)
        fresh: np.ndarray = np.flatnonzero(self.loops.accepted & ~loops.accepted)
        return fresh

    def _see(self, scans: Sequence[KeyScan]) -> None:
        for scan in scans[len(self.views) :]:
            self.views.append(scan)

    def reorder(self, scans: Sequence[KeyScan], order: np.ndarray) -> None:
        """Take that the key scans, ``scans`` as they were, have the order ``order`` ``(keys,)`` of old numbers now."""
        self._see(scans)
        number = np.argsort(order)
        self.views.reorder(order)
        self.loops = replace(self.loops, pairs=number[self.loops.pairs])
        self._submaps.renumber(number)

    def add(self, loops: ScanLoops) -> np.ndarray:
        """Take loops that were found and judged elsewhere; returns which of ``loops`` they are."""
        known, self.loops = len(self.loops), self.loops.extended(loops)
        return np.arange(known, len(self.loops))

    @property
    def used(self) -> np.ndarray:
        """Which of ``loops`` the graph uses ``(n,)``."""
        return self._used.values

    def drop(self, chosen: np.ndarray) -> int:
        """See ``LoopFinder.drop``."""
        used = self.used.copy()
        self._used.set(used[~chosen[used]])
        self.doubted = self.doubted[~chosen[self.doubted]]
        return int(chosen[used].sum())

    def thin(self, keep: np.ndarray, used: ScanLoops, newest: np.ndarray) -> None:
        """Let go of the keys that are not among ``keep`` ``(keys,)``; the graph then uses the loops ``used``.

        Loops of the keys ``newest`` ``(keys,)`` that it does not use stay as well: others may still agree with them.
        """
        found, number = self.loops, np.cumsum(keep) - 1
        waits = newest[found.pairs[:, 1]] & keep[found.pairs].all(1)
        waits[self.used] = False
        unused = np.flatnonzero(waits)
        loops = used.extended(found[unused])
        self.loops = replace(loops, pairs=number[loops.pairs])
        self.doubted = len(used) + np.flatnonzero(np.isin(unused, self.doubted))
        self._used.set(np.arange(len(used)))
        self.views.thin(keep)
        self._submaps = ScanSubmaps(self.config.loops)

    def believed(self, fresh: np.ndarray, graph: PoseGraph) -> np.ndarray:
        """Those of the newly accepted loops that the graph may use, and of others that have waited.

        A search distinguishes places within its window alone. A robot that may be farther away may be in another place
        that looks alike, which was not searched: then more loops must agree. A loop waits for as long as more may.
        """
        rows = np.concatenate((self.doubted, fresh))
        if len(rows) == 0:
            return rows
        config, loops, known = self.config, self.loops[rows], self.loops[self.used]
        covariance = path_covariances(
            graph.poses,
            np.concatenate((graph.edges, known.pairs)),
            np.concatenate((graph.step_covariance, known.covariance)),
            loops.pairs,
        )
        windows = covariance_windows(config.windows, covariance)
        searched = (windows[:, 0] < config.windows.most_m) & (windows[:, 2] < math.radians(config.windows.most_deg))
        believed = searched | (loops.agreeing >= config.agreeing_beyond)
        later = loops.pairs[:, 1]
        may_grow = later >= graph.stream_ends[graph.stream_of(later)] - config.loops.neighbour_keys
        self.doubted = rows[~believed & may_grow]
        return rows[believed]

    def use(self, rows: np.ndarray, graph: PoseGraph) -> bool:
        """Take those of the believed loops into the graph that it needs; returns whether one surprises."""
        loops, known, config = self.loops[rows], self.loops[self.used], self.config
        measured = RelativePoses.of_covariances(loops.pairs, loops.relative, loops.covariance)
        off = (measured.residuals(graph.poses) ** 2).sum(1)
        at_walls = np.tile(np.diag((1.0, 1.0, WALLS_M)), (len(rows), 1, 1))
        moved = (RelativePoses(loops.pairs, loops.relative, at_walls).residuals(graph.poses) ** 2).sum(1)
        surprising = (off > config.surprise**2) & (moved > config.surprise_m**2)
        needed = needed_loops(
            np.concatenate((graph.edges, known.pairs)),
            np.concatenate((graph.step_variance, largest_variances(known.covariance))),
            loops.pairs,
            largest_variances(loops.covariance),
            surprising,
            config.redundant,
        )
        for row in rows[needed]:
            self._used.append(row)
        return bool(surprising.any())

    SAVED = ("views", "loops", "_submaps", "_used", "doubted")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored loops between key scans that are not there."""
        keys, pairs = len(self.views), self.loops.pairs
        require(bool(((pairs >= 0) & (pairs < keys)).all()), f"a loop joins key scans that are not among the {keys}")
        for rows in (self.used, self.doubted):
            named = bool(((rows >= 0) & (rows < len(pairs))).all())
            require(named, f"loops are named that are not among the {len(pairs)}")

    def _verified(
        self, scans: Sequence[KeyScan], poses: np.ndarray, place: int, likely: np.ndarray, segments: np.ndarray | None
    ) -> ScanLoops | None:
        """A loop of the last key with the submap of a place, if it passes every test but that of its neighbours.

        The key is ``likely`` ``(3,)`` that near to its pose in the graph; it is searched somewhat farther.
        """
        config, key = self.config.loops, len(scans) - 1
        there = around_in_time(place, len(scans), config.submap_keys, segments)
        submap = self._submaps.around(place, there, scans, self.views.profiles, poses)
        first = max(0, key + 1 - config.source_keys)
        source = laid_together(scans[first:], self.views.profiles[first:], poses[first:])
        expected = between(poses[place], poses[key])
        found = fit(config, submap, source, expected, likely * (config.search_factor, config.search_factor, 1.0))
        if found is None:
            return None
        registered, evidence = found
        off = registered.pose - expected
        off[2] = wrap(off[2])
        disagreement = float(np.linalg.norm(3.0 * off / likely))
        if disagreement > config.most_disagreement:
            return None
        # From the nearest of the submap's keys: its pose in the submap is the least uncertain.
        nearest = int(np.argmin(np.linalg.norm(submap.poses[:, :2] - registered.pose[:2], axis=1)))
        earlier = submap.poses[nearest]
        covariance = turned_covariance(-earlier[2], registered.covariance) + SUBMAP_VARIANCE
        return ScanLoops(
            np.array(((submap.first + nearest, key),)),
            between(earlier, registered.pose)[None],
            covariance[None],
            np.array(((*evidence, disagreement, 0.0),)),
            np.zeros(1, bool),
        )
