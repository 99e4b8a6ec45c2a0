"""A robot that is found again in the map that it is making: the newest scans, searched where no window reaches.

The key scans that are searched are those of parts of the map that no loop joins with the newest one, and those that are
so far from it through the graph that it may be outside of the widest window. As in a saved map, a pose is claimed where
sightings of several scans agree by the odometry between them, and the last stretch of the way agrees with the place, in
more walls than places have in common by chance, and with no other place nearly as well. Each of these sightings is then
a loop. The corrector may still refuse it, and the next scans may contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, compose, turned_covariance
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.graph.segments import segment_of
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.place_evidence import PlaceEvidence, evidence_of, last_stretch
from ngo_estimator.loops.scan_loops import EVIDENCE, ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.loops.scan_submaps import laid_together
from ngo_estimator.slam.evidence import HypothesisWindow, agreeing, fused, strongest_modes
from ngo_estimator.slam.localisation import LocalisationConfig, may_claim
from ngo_estimator.slam.scan_matcher import REACH_M, ScanMatcher
from ngo_estimator.slam.sightings import Sightings

_GROWN = 1.1
"""The map is laid out anew when so many times as many key scans are to be searched."""

_TRIAL_LOOKS, _CONTRADICTIONS = 40, 3
"""Looks after a claim in which the newest scans may still contradict it, and how many in a row do."""


_SURE_M = 1.5
"""Half width of the search (m) around key scans against which the newest pose is taken to be sure."""

_HERE, _ELSEWHERE, _LEAST_SEEN, _LOOKS_ELSEWHERE = 0.25, 0.35, 200, 4
"""Mean share of sightings through walls up to which that is right, and from which on it is wrong, of so many at least;
the looks for which it must be wrong."""

_HELD_AGAINST = 20
"""Key scans at most that the newest are held against."""

_LEAST_OVERLAP = 0.2
"""Share of points that the other side sees at least: through glass alone all sightings go through walls, but few."""


class OwnMap:
    """Takes each newest key scan, and says where else in the map the robot was when it took the last ones."""

    def __init__(self, config: ScanGraphConfig, claims: LocalisationConfig | None = None) -> None:
        self._config = config
        self._claims = claims or LocalisationConfig()
        self._window = HypothesisWindow(self._claims.window)
        self.looks = np.zeros(0, np.int64)
        """The key scan of each look in the window."""
        # The key scans that are searched, and where they lie: parts of the map beside each other.
        self._keys, self._poses = np.zeros(0, np.int64), np.zeros((0, 3))
        self._stale, self._parts = 1, 0  # whether they are to be laid out anew, and of how many parts they are
        self._matcher: ScanMatcher | None = None
        # Looks for which the newest segment may still turn out to lie elsewhere, and how many in a row say so.
        self._trial, self._against = 0, 0
        # Key scans of looks: the last one that agreed with the map where the pose is sure, and those against it since.
        self._agreed, self._astray = 0, np.zeros(0, np.int64)

    def follow(self, graph: PoseGraph) -> None:
        """Take the step to the newest key scan; nobody knows it where that begins a segment."""
        if graph.segments[-1] == len(graph) - 1:
            self._forget_looks()
            self._trial = self._against = 0
        else:
            self._window.move(graph.relative[-1], graph.step_covariance[-1])

    def fits(self, keys: int) -> bool:
        """Whether all key scans that it names are among the first so many."""
        return all(bool(((named >= 0) & (named < keys)).all()) for named in (self.looks, self._keys, self._astray))

    def _forget_looks(self) -> None:
        self._window.clear()
        self.looks = self.looks[:0]

    def look(
        self, scans: Sequence[KeyScan], views: KeyScanViews, graph: PoseGraph, windows: np.ndarray, parts: np.ndarray
    ) -> ScanLoops:
        """Loops of the last key scans, where it is beyond doubt that they are right; mostly none.

        Args:
            scans, views: of all key scans.
            windows: half widths of the search around each, as seen from the newest ``(keys, 3)``.
            parts: the part of the map that each segment is in ``(segments,)``.
        """
        config, newest = self._config.loops, len(graph) - 1
        first = newest + 1 - config.source_keys
        far = np.flatnonzero(windows[:, 0] >= self._config.windows.most_m)
        if first < graph.segments[-1] or len(far) < config.submap_keys:
            return ScanLoops.none()
        self._lay_out(far, parts[segment_of(graph.segments, far)], graph.poses)
        matcher = self._matcher_of(scans, views)
        if matcher is None:
            return ScanLoops.none()
        source = laid_together(scans[first:], views.profiles[first:], graph.poses[first:])
        self._window.add(matcher.search(source))
        self.looks = np.append(self.looks, newest)[-self._claims.window :]
        hypotheses, place_m = self._window.hypotheses(), matcher.place_m
        modes = strongest_modes(hypotheses, place_m)
        if not modes:
            return ScanLoops.none()
        # No share of all looks must support it: between sightings the robot was perhaps where it had never been.
        if not may_claim(self._claims, self._window, modes[0], place_m):
            return ScanLoops.none()
        agree = agreeing(hypotheses, modes[0].pose_xyyaw, modes[0].covariance, place_m)
        pose, _ = fused(hypotheses.where(agree), modes[0].pose_xyyaw)
        rivals = [mode.pose_xyyaw for mode in modes[1:] if mode.support > self._claims.most_rival * modes[0].support]
        found, *others = (self._evidence(at, scans, views, graph) for at in (pose, *rivals))
        if not found.suffices or any(other.rivals(found) for other in others):
            return ScanLoops.none()
        loops = self._loops(agree, self.looks[hypotheses.look], modes[0].support)
        self._forget_looks()
        if (loops.pairs[:, 0] < graph.segments[-1]).any():
            self._trial, self._against = _TRIAL_LOOKS, 0
        return loops

    def _evidence(
        self, pose: np.ndarray, scans: Sequence[KeyScan], views: KeyScanViews, graph: PoseGraph
    ) -> PlaceEvidence:
        """How the last stretch of the way agrees with the searched key scans, where the newest one is at a pose."""
        stretch = last_stretch(graph.poses, int(graph.segments[-1]))
        at = se2.compose(pose, se2.between(graph.poses[-1], graph.poses[stretch]))
        return evidence_of(scans, views, (stretch, at), (self._keys, self._poses), count_walls=True)

    def contradicted(
        self, scans: Sequence[KeyScan], views: KeyScanViews, graph: PoseGraph, windows: np.ndarray, parts: np.ndarray
    ) -> bool:
        """Whether the key scans since the newest segment was joined show that it lies elsewhere.

        Two places may be alike for as far as the robot went; what it sees next is alike in one place alone.
        """
        first, newest = int(graph.segments[-1]), len(graph) - 1
        joined = parts[segment_of(graph.segments, np.arange(first))] == parts[-1]
        others = np.flatnonzero(joined & (windows[:first, 0] <= _SURE_M))  # walls of a bent map lie elsewhere
        if self._trial == 0 or not len(others):
            return False
        last = np.arange(newest + 1 - self._config.loops.source_keys, newest + 1)
        found = evidence_of(scans, views, (last, graph.poses[last]), (others, graph.poses[others]))
        if found.said:
            self._trial -= 1
            self._against = self._against + 1 if found.mean > _ELSEWHERE else 0
        if self._against < _CONTRADICTIONS:
            return False
        self._trial = self._against = 0
        self._forget_looks()
        return True

    def astray(
        self,
        scans: Sequence[KeyScan],
        views: KeyScanViews,
        graph: PoseGraph,
        windows: np.ndarray,
        has_loops: bool,
    ) -> int | None:
        """The key scan from which on the robot is not where the graph has it; None where nothing says so.

        Where the graph is sure of the pose, scans that look through the walls there say that a step was wrong.
        ``has_loops``: whether the newest key scan has one.
        """
        newest, config, border = len(graph) - 1, self._config.loops, graph.borders[-1]
        if has_loops:
            self._agreed, self._astray = newest, self._astray[:0]
        last = np.arange(newest + 1 - config.source_keys, newest + 1)
        if has_loops or last[0] < border:
            return None
        way = np.cumsum(np.hypot(*np.diff(graph.poses[::-1, :2], axis=0).T))[::-1]  # to the newest, of all others
        old = np.flatnonzero((windows[:newest, 0] <= _SURE_M) & (way > config.least_gap_m))
        if not len(old):
            return None
        found = evidence_of(scans, views, (last, graph.poses[last]), (old, graph.poses[old]), _HELD_AGAINST)
        if found.said and found.mean <= _HERE:
            self._agreed, self._astray = newest, self._astray[:0]
        elif found.seen >= _LEAST_SEEN and found.overlap >= _LEAST_OVERLAP and found.mean > _ELSEWHERE:
            self._astray = np.append(self._astray, newest)
        if len(self._astray) < _LOOKS_ELSEWHERE:
            return None
        first = max(self._agreed + 1, int(self._astray[0]) - config.source_keys)
        self._agreed, self._astray = newest, self._astray[:0]
        self._forget_looks()
        return first if first > border else None

    def thin(self, keep: np.ndarray) -> None:
        """Take that the key scans that are not among ``keep`` ``(keys,)`` are gone."""
        left, number = keep[self._keys], np.cumsum(keep) - 1
        self._keys, self._poses = number[self._keys[left]], self._poses[left]
        self.looks, self._astray = number[self.looks], number[self._astray]
        self._agreed = int(number[self._agreed])
        self.map_changed()

    def renumber(self, number: np.ndarray) -> None:
        """Take that each key scan has another number ``(keys,)`` now."""
        self._keys, self.looks, self._astray = number[self._keys], number[self.looks], number[self._astray]
        self._agreed = int(number[self._agreed])

    def map_changed(self) -> None:
        """Lay out the map anew at the next look: scans are gone, or many poses were moved."""
        self._stale = 1

    def _lay_out(self, keys: np.ndarray, part: np.ndarray, poses: np.ndarray) -> None:
        """Lay out the key scans that are to be searched, unless nearly all of them are."""
        parts = len(np.unique(part))
        if not self._stale and parts == self._parts and len(keys) <= _GROWN * len(self._keys):
            return
        before = self._keys, self._poses
        self._keys, self._poses = keys, _apart(poses[keys], part, 2.0 * self._config.loops.range_m)
        self._window.map_sightings(lambda seen: self._laid_anew(seen, *before))
        self._stale, self._parts, self._matcher = 0, parts, None

    def _matcher_of(self, scans: Sequence[KeyScan], views: KeyScanViews) -> ScanMatcher | None:
        """What searches in them; None where none of them has a point."""
        if self._matcher is None:
            keys = self._keys.tolist()
            chosen = [scans[key] for key in keys]
            if any(len(scan.points) for scan in chosen):
                views = views.of_keys(keys)
                self._matcher = ScanMatcher(chosen, self._poses, views, self._config.loops, REACH_M)
        return self._matcher

    def _laid_anew(self, seen: Sightings, keys: np.ndarray, poses: np.ndarray) -> Sightings:
        """Sightings in a map that lay otherwise: each goes with the key scan that was nearest."""
        near = _nearest(poses, seen.poses)
        there = np.isin(keys[near], self._keys)
        seen, near = seen.where(there), near[there]
        old, new = poses[near], self._poses[np.searchsorted(self._keys, keys[near])]
        moved = [compose(b, between(a, pose)) for a, b, pose in zip(old, new, seen.poses, strict=True)]
        turned = [turned_covariance(b[2] - a[2], c) for a, b, c in zip(old, new, seen.covariance, strict=True)]
        return Sightings(np.array(moved).reshape(-1, 3), np.array(turned).reshape(-1, 3, 3), seen.belief)

    def _loops(self, agree: np.ndarray, later: np.ndarray, support: float) -> ScanLoops:
        """A loop of each sighting that agrees, from the searched key scan that is nearest."""
        sightings = self._window.sightings
        poses = np.concatenate([seen.poses for seen in sightings])[agree]
        covariance = np.concatenate([seen.covariance for seen in sightings])[agree]
        near = _nearest(self._poses, poses)
        earlier = self._poses[near]
        relative = [between(a, b) for a, b in zip(earlier, poses, strict=True)]
        turned = [turned_covariance(-a[2], c) for a, c in zip(earlier, covariance, strict=True)]
        evidence = np.zeros((len(poses), len(EVIDENCE)))
        evidence[:, EVIDENCE.index("agreeing")] = support
        pairs = np.stack((self._keys[near], later[agree]), axis=1)
        return ScanLoops(pairs, np.stack(relative), np.stack(turned), evidence, np.ones(len(poses), bool))

    SAVED = (
        "_window", "looks", "_keys", "_poses", "_stale", "_parts", "_trial", "_against", "_agreed",
        "_astray",
    )  # fmt: skip

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        require(len(self.looks) == len(self._window), f"{len(self._window)} looks are not of as many key scans")
        require(len(self._keys) == len(self._poses), f"{len(self._keys)} key scans do not have as many poses")


def _nearest(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Row of the pose ``(n, 3)`` that is nearest to each of the others ``(m, 3)``."""
    away = np.linalg.norm(others[:, None, :2] - poses[None, :, :2], axis=2)
    return away.argmin(axis=1) if len(poses) else np.zeros(0, np.int64)


def _apart(poses: np.ndarray, part: np.ndarray, gap_m: float) -> np.ndarray:
    """Poses ``(n, 3)`` of parts of a map, the parts ``(n,)`` put beside each other with a gap between."""
    laid, end = poses.copy(), 0.0
    for one in np.unique(part):
        own = part == one
        low, high = poses[own, :2].min(0), poses[own, :2].max(0)
        laid[own, :2] -= low - (end, 0.0)
        end += float(high[0] - low[0]) + gap_m
    return laid
