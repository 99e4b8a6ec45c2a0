"""Finds loops of 2D lidar key scans, verified without learning.

A new key asks for loops with earlier keys near which the robot may be. Its scan and the scans of the
keys before it are searched in a submap of an earlier key. A loop is accepted where they fit, near the graph's pose, and
a neighbouring loop agrees. No loop is better than a wrong one.
"""

from collections.abc import Sequence

import numpy as np

from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, turned_covariance, wrap
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_fit import fit
from ngo_estimator.loops.scan_loop_agreement import with_agreement
from ngo_estimator.loops.scan_loop_candidates import LoopCandidate, loop_candidates
from ngo_estimator.loops.scan_loops import ScanLoops
from ngo_estimator.loops.scan_settings import ScanLoopConfig
from ngo_estimator.loops.scan_submaps import SUBMAP_VARIANCE, ScanSubmaps, laid_together


class ScanLoopFinder:
    """Finds loops of each new key, and keeps all that were verified: a loop is accepted when a neighbour agrees."""

    def __init__(self, config: ScanLoopConfig) -> None:
        self.config = config
        self.loops = ScanLoops.none()
        self.views = KeyScanViews()
        """Of all key scans that ``find`` has seen."""
        self._submaps = ScanSubmaps(config)

    def find(
        self,
        scans: Sequence[KeyScan],
        poses: np.ndarray,
        windows: np.ndarray,
        segments: np.ndarray | None = None,
    ) -> np.ndarray:
        """Loops of the last key, under the present poses.

        Args:
            scans: of all keys, in their order; each call has one more than the call before, or more.
            poses: of all keys in the map ``(keys, 3)``.
            windows: half widths of the search around each key's pose, as seen from the last ``(keys, 3)`` (m, m, rad).
            segments: keys from which on scans do not lie together with those before; None: all do.

        Returns:
            Which of ``loops`` ``(n,)`` this call made acceptable, the last key's and earlier ones with which they
            agree.
        """
        count, config = len(scans), self.config
        if poses.shape != (count, 3) or windows.shape != (count, 3):
            raise ValueError(
                f"poses, windows have the shapes {poses.shape}, {windows.shape} for {count} scans; expected (keys, 3)"
            )
        for scan in scans[len(self.views) :]:
            self.views.append(scan)
        if (count - 1) % config.every:
            return np.zeros(0, np.int64)
        if not (windows > 0.0).all():
            raise ValueError(f"the narrowest of the windows is {windows.min()}; expected positive half widths")
        if segments is not None and count - segments[-1] < config.source_keys:
            return np.zeros(0, np.int64)  # scans of two segments do not lie together
        loops = self.loops
        for candidate in loop_candidates(config, self.views, poses, windows):
            loop = self._verified(scans, poses, candidate, segments)
            if loop is not None:
                loops = loops.extended(loop)
        if len(loops) == len(self.loops):
            return np.zeros(0, np.int64)
        self.loops = with_agreement(config, loops, len(self.loops), poses)
        fresh: np.ndarray = np.flatnonzero(self.loops.accepted & ~loops.accepted)
        return fresh

    def add(self, loops: ScanLoops) -> np.ndarray:
        """Take loops that were found and judged elsewhere; returns which of ``loops`` they are."""
        known, self.loops = len(self.loops), self.loops.extended(loops)
        return np.arange(known, len(self.loops))

    def thin(self, keep: np.ndarray, loops: ScanLoops) -> None:
        """Let go of the keys that are not among ``keep`` ``(keys,)``; ``loops`` are those between the others."""
        self.views.thin(keep)
        self._submaps = ScanSubmaps(self.config)
        self.loops = loops

    SAVED = ("views", "loops", "_submaps")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored loops between key scans that are not there."""
        keys, pairs = len(self.views), self.loops.pairs
        require(bool(((pairs >= 0) & (pairs < keys)).all()), f"a loop joins key scans that are not among the {keys}")

    def _verified(
        self, scans: Sequence[KeyScan], poses: np.ndarray, candidate: LoopCandidate, segments: np.ndarray | None
    ) -> ScanLoops | None:
        """A loop of the last key with the submap of a place, if it passes every test but that of its neighbours."""
        config, key = self.config, len(scans) - 1
        submap = self._submaps.around(candidate.place, scans, self.views.profiles, poses, segments)
        first = max(0, key + 1 - config.source_keys)
        source = laid_together(scans[first:], self.views.profiles[first:], poses[first:])
        found = fit(config, submap, source, candidate.centre, candidate.window)
        if found is None:
            return None
        off = found.pose - between(poses[candidate.place], poses[key])
        off[2] = wrap(off[2])
        disagreement = float(np.linalg.norm(3.0 * off / candidate.likely))
        if disagreement > config.most_disagreement:
            return None
        # From the nearest of the submap's keys: its pose in the submap is the least uncertain.
        nearest = int(np.argmin(np.linalg.norm(submap.poses[:, :2] - found.pose[:2], axis=1)))
        earlier = submap.poses[nearest]
        covariance = turned_covariance(-earlier[2], found.covariance) + SUBMAP_VARIANCE
        return ScanLoops(
            np.array(((submap.first + nearest, key),)),
            between(earlier, found.pose)[None],
            covariance[None],
            np.array(((found.response, found.second_peak, found.on_lines, found.through, disagreement, 0.0),)),
            np.zeros(1, bool),
        )
