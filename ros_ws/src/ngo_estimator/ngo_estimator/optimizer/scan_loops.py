"""Loops of 2D lidar key scans, verified without learning.

Not in the paper. A new key asks for loops with earlier keys near which the robot may be. Its scan and the scans of the
keys before it are searched in a submap of an earlier key, by branch and bound (Hess et al. 2016, section V), then
registered point to line (Censi 2008). A loop is accepted where points lie on lines, no wall is seen through, no other
pose fits nearly as well, and a neighbouring loop agrees. No loop is better than a wrong one.
"""

import math
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import (
    Arrays,
    flat,
    part,
    require,
    split,
    taken,
    taken_indices,
    taken_integer,
    under,
)
from ngo_estimator.geometry.branch_and_bound import PooledGrid, SearchConfig, pooled_grid, search
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.line_map import LineMap, line_map_of_points
from ngo_estimator.geometry.planar_motion import between, compose, turned_covariance, wrap
from ngo_estimator.geometry.scan_matching import icp
from ngo_estimator.optimizer.scan_loop_candidates import nearest_places
from ngo_estimator.optimizer.walls_seen_through import PROFILE_BINS, PlacedScans, placed, range_profile, seen_through

_NEAR_M = 10.0
"""Points up to there say where a scan looks."""

_SUBMAP_VARIANCE = np.diag((0.01**2, 0.01**2, math.radians(0.15) ** 2))
"""Of the submap's own keys against each other, which registration in it can't see."""

EVIDENCE = ("response", "second_peak", "on_lines", "seen_through", "disagreement", "agreeing")
"""Columns of a loop's evidence.

The mean likelihood of the points (0 to 1), the second peak's share of it, the share of points on lines, the share of
sightings through walls, the distance from the graph's pose in deviations (a third of the window), and the number of
neighbouring loops that agree.
"""

_DISAGREEMENT, _AGREEING = EVIDENCE.index("disagreement"), EVIDENCE.index("agreeing")


_LOOP_ROWS: dict[str, tuple[type, tuple[int, ...]]] = {
    "pairs": (np.int64, (2,)),
    "relative": (np.float64, (3,)),
    "covariance": (np.float64, (3, 3)),
    "evidence": (np.float64, (len(EVIDENCE),)),
    "accepted": (np.bool_, ()),
}
"""Type and shape of a loop's row in each array of ``ScanLoops``."""

_PLACED_ROWS = {"points": (2,), "normals": (2,), "sensors": (3,), "profiles": (PROFILE_BINS,)}
"""The same of ``PlacedScans``, all float64."""


@dataclass(frozen=True)
class ScanLoopConfig:
    """How loops are looked for, and which are accepted.

    Every ``every``-th key asks, at up to ``most_per_key`` places that are ``least_gap_m`` of path and more behind it.
    Places are every ``place_step``-th key, with ``submap_keys`` keys around each; ``source_keys`` keys are searched
    together, by ``search_points`` of their points. A place may be ``reach_m`` outside of the window. Positions are
    searched over ``search_factor`` times the window, so that a second peak beside it is seen. A match of places
    is searched ``match_m`` around the place. Points farther than ``range_m`` from the robot take no part in the search,
    and ``most_submaps`` submaps are kept: both bound the memory.

    A loop needs ``least_response``, at most ``most_second`` of it at another pose, ``least_on_lines`` of the points on
    lines, at most ``most_seen_through`` of the sightings through walls, and at most ``most_disagreement`` deviations
    from the graph's pose. It needs ``least_agreeing`` loops of other keys, at most ``neighbour_keys`` away at both
    ends, that agree to ``agreement_m`` and ``agreement_deg``, and ``agreeing_per_deviation`` for each deviation from
    the graph's pose: the more a loop would change, the more of them.
    """

    search: SearchConfig = field(default_factory=SearchConfig)
    every: int = 2
    most_per_key: int = 3
    least_gap_m: float = 8.0
    place_step: int = 5
    submap_keys: int = 15
    source_keys: int = 4
    search_points: int = 300
    reach_m: float = 2.0
    search_factor: float = 2.0
    match_m: float = 4.0
    range_m: float = 20.0
    most_submaps: int = 24
    least_response: float = 0.55
    most_second: float = 0.9
    least_on_lines: float = 0.6
    most_seen_through: float = 0.15
    most_disagreement: float = 3.0
    least_agreeing: int = 1
    agreeing_per_deviation: float = 2.0
    neighbour_keys: int = 12
    agreement_m: float = 0.25
    agreement_deg: float = 4.0

    def __post_init__(self) -> None:
        for name in ("every", "place_step", "submap_keys", "source_keys", "search_points", "most_submaps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least 1")
        for name in ("most_per_key", "least_agreeing", "neighbour_keys"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least 0")
        shares = (self.least_response, self.most_second, self.least_on_lines, self.most_seen_through)
        if not all(0.0 <= x <= 1.0 for x in shares):
            raise ValueError(
                "least_response, most_second, least_on_lines, most_seen_through are "
                f"{shares}; expected shares from 0 to 1"
            )
        lengths = (
            self.least_gap_m, self.reach_m, self.match_m, self.range_m, self.agreement_m, self.agreement_deg
        )  # fmt: skip
        if not all(0.0 <= x < math.inf for x in lengths):
            raise ValueError(
                f"least_gap_m, reach_m, match_m, range_m, agreement_m, agreement_deg are {lengths}; expected finite "
                "numbers from 0 on"
            )
        if not 1.0 <= self.search_factor < math.inf:
            raise ValueError(f"search_factor is {self.search_factor}; expected a finite number of at least 1")
        if not (self.most_disagreement >= 0.0 and 0.0 <= self.agreeing_per_deviation < math.inf):
            raise ValueError(
                f"most_disagreement, agreeing_per_deviation are {self.most_disagreement}, "
                f"{self.agreeing_per_deviation}; expected numbers from 0 on, the second finite"
            )
        if self.source_keys > self.submap_keys:
            raise ValueError(
                f"source_keys, submap_keys are {self.source_keys}, {self.submap_keys}; expected no more in the source"
            )


@dataclass(frozen=True)
class ScanLoops:
    """Loops between key scans.

    Attributes:
        pairs: indices of the keys ``(e, 2)``, the earlier first.
        relative: pose of the later in the earlier ``(e, 3)`` (m, m, rad).
        covariance: of these poses ``(e, 3, 3)``, along the axes of the earlier.
        evidence: ``(e, 6)``, columns as named in ``EVIDENCE``.
        accepted: whether to believe each ``(e,)``.
    """

    pairs: np.ndarray
    relative: np.ndarray
    covariance: np.ndarray
    evidence: np.ndarray
    accepted: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.pairs)
        shapes = tuple(x.shape for x in (self.pairs, self.relative, self.covariance, self.evidence, self.accepted))
        if shapes != ((count, 2), (count, 3), (count, 3, 3), (count, len(EVIDENCE)), (count,)):
            raise ValueError(f"the arrays of loops have the shapes {shapes}; expected e rows of 2, 3, 3 x 3, 6 and 1")

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, rows: np.ndarray | slice) -> "ScanLoops":
        """Some of the loops."""
        return ScanLoops(
            self.pairs[rows], self.relative[rows], self.covariance[rows], self.evidence[rows], self.accepted[rows]
        )

    @property
    def agreeing(self) -> np.ndarray:
        """How many neighbouring loops agree with each ``(e,)``."""
        return self.evidence[:, _AGREEING]

    @staticmethod
    def none() -> "ScanLoops":
        """No loops."""
        return ScanLoops(
            np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, len(EVIDENCE))),
            np.zeros(0, bool),
        )  # fmt: skip

    def extended(self, others: "ScanLoops") -> "ScanLoops":
        """These loops, then the others."""
        return ScanLoops(
            np.concatenate((self.pairs, others.pairs)),
            np.concatenate((self.relative, others.relative)),
            np.concatenate((self.covariance, others.covariance)),
            np.concatenate((self.evidence, others.evidence)),
            np.concatenate((self.accepted, others.accepted)),
        )


@dataclass(frozen=True)
class _Submap:
    """Scans around a key, in its frame: ``poses`` of the keys from ``first`` on, as they were when it was made. Without
    any point there is no grid."""

    first: int
    poses: np.ndarray
    scans: PlacedScans
    lines: LineMap
    grid: PooledGrid | None


@dataclass(frozen=True)
class _Fit:
    """How scans lie in a submap: ``pose`` ``(3,)``, ``covariance`` ``(3, 3)``, and evidence as in ``EVIDENCE``."""

    pose: np.ndarray
    covariance: np.ndarray
    response: float
    second_peak: float
    on_lines: float
    through: float


@dataclass(frozen=True)
class _Candidate:
    """A place, and where in it the last key is searched: ``centre`` plus and minus ``window``, both ``(3,)``. The last
    key is ``likely`` that near to its pose in the graph."""

    place: int
    centre: np.ndarray
    window: np.ndarray
    likely: np.ndarray


class ScanLoopFinder:
    """Finds loops of each new key, and keeps all that were verified: a loop is accepted when a neighbour agrees."""

    def __init__(self, config: ScanLoopConfig) -> None:
        self.config = config
        self.loops = ScanLoops.none()
        self._profiles: list[np.ndarray] = []
        self._middles = GrowingRows((2,), np.float64)
        self._forgotten: set[int] = set()
        self._submaps: OrderedDict[int, _Submap] = OrderedDict()

    def find(
        self, scans: Sequence[KeyScan], poses: np.ndarray, windows: np.ndarray, matches: Sequence[int] = ()
    ) -> np.ndarray:
        """Loops of the last key, under the present poses.

        Args:
            scans: of all keys, in their order; each call has one more than the call before, or more.
            poses: of all keys in the map ``(keys, 3)``.
            windows: half widths of the search around each key's pose, as seen from the last ``(keys, 3)`` (m, m, rad).
            matches: earlier keys that look like the last one, best first. They go before those near the pose, and are
                searched in all directions.

        Returns:
            Which of ``loops`` ``(n,)`` this call made acceptable, the last key's and earlier ones with which they
            agree.
        """
        count, config = len(scans), self.config
        if poses.shape != (count, 3) or windows.shape != (count, 3):
            raise ValueError(
                f"poses, windows have the shapes {poses.shape}, {windows.shape} for {count} scans; expected (keys, 3)"
            )
        for scan in scans[len(self._profiles) :]:
            self._profiles.append(range_profile(scan).astype(np.float32))  # as scans have them: nothing is lost
            self._middles.append(_middle(scan.points))
        if (count - 1) % config.every:
            return np.zeros(0, np.int64)
        if not (windows > 0.0).all():
            raise ValueError(f"the narrowest of the windows is {windows.min()}; expected positive half widths")
        found = ScanLoops.none()
        for candidate in self._candidates(poses, windows, matches):
            loop = self._verified(scans, poses, candidate)
            if loop is not None:
                found = found.extended(loop)
        return self._agreed(found, poses)

    def forget(self, keys: Iterable[int]) -> None:
        """Look for no more loops at these keys, whose scans are gone."""
        nothing = np.zeros_like(self._profiles[0]) if self._profiles else np.zeros(0, np.float32)
        for key in keys:
            self._profiles[key] = nothing
            self._forgotten.add(key)

    def state(self) -> Arrays:
        """All that later calls depend on, for ``restore``.

        Submaps are among it: their scans lie where the poses had them when they were made, and may be gone since.
        """
        profiles = [profile for key, profile in enumerate(self._profiles) if key not in self._forgotten]
        submaps = list(self._submaps.values())
        arrays: Arrays = {
            "keys": np.array(len(self._profiles)),
            "profiles": np.array(profiles, np.float32).reshape(-1, PROFILE_BINS),
            "middles": self._middles.values,
            "forgotten": np.array(sorted(self._forgotten), np.int64),
            "places": np.array([(place, submap.first) for place, submap in self._submaps.items()], np.int64).reshape(
                -1, 2
            ),
            **under("loops", {name: getattr(self.loops, name) for name in _LOOP_ROWS}),
            **under("submaps.poses", flat([submap.poses for submap in submaps], np.zeros((0, 3)))),
        }
        for name, shape in _PLACED_ROWS.items():
            rows = [getattr(submap.scans, name) for submap in submaps]
            arrays |= under(f"submaps.{name}", flat(rows, np.zeros((0, *shape))))
        return arrays

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()``, in place of what is here; raises ``StateError``."""
        count = taken_integer(arrays, "keys")
        loops = part(arrays, "loops")
        pairs = taken(loops, "pairs", np.int64, -1, 2)
        rows = {name: taken(loops, name, dtype, len(pairs), *shape) for name, (dtype, shape) in _LOOP_ROWS.items()}
        require(bool(((pairs >= 0) & (pairs < count)).all()), f"a loop joins key scans that are not among the {count}")
        self.loops = ScanLoops(**rows)
        self._middles.restore(arrays, "middles")
        require(len(self._middles) == count, f"there are not {count} middles of key scans")
        forgotten = taken_indices(arrays, "forgotten", count)
        self._forgotten = set(forgotten.tolist())
        known = np.setdiff1d(np.arange(count), forgotten)
        profiles = taken(arrays, "profiles", np.float32, len(known), PROFILE_BINS)
        self._profiles = [np.zeros(PROFILE_BINS, np.float32)] * count
        for key, profile in zip(known.tolist(), profiles, strict=True):
            self._profiles[key] = profile
        places = taken(arrays, "places", np.int64, -1, 2)
        poses = split(part(arrays, "submaps.poses"), np.float64, 3)
        placed = [split(part(arrays, f"submaps.{name}"), np.float64, *shape) for name, shape in _PLACED_ROWS.items()]
        require({len(parts) for parts in (poses, *placed)} == {len(places)}, f"there are not {len(places)} submaps")
        self._submaps = OrderedDict(
            (place, self._submap_of(first, local, PlacedScans(*scans)))
            for (place, first), local, *scans in zip(places.tolist(), poses, *placed, strict=True)
        )

    def _candidates(self, poses: np.ndarray, windows: np.ndarray, matches: Sequence[int]) -> list[_Candidate]:
        config, key = self.config, len(poses) - 1
        path = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))))
        last = int(np.searchsorted(path, path[-1] - config.least_gap_m)) - config.submap_keys // 2
        last = min(last, key - config.source_keys - config.submap_keys // 2)
        steps = range(0, max(0, last), config.place_step)
        places = [place for place in steps if place not in self._forgotten]
        if len(places) == 0:
            return []
        seen = dict.fromkeys(steps[min(round(m / config.place_step), len(steps) - 1)] for m in matches if 0 <= m < last)
        around = np.array((config.match_m, config.match_m, math.pi))
        chosen = [_Candidate(p, np.zeros(3), around, windows[p]) for p in seen if p not in self._forgotten]
        views = _views(poses, self._middles.values)
        near = nearest_places(
            views, poses, windows, places, reach_m=config.reach_m, apart=config.submap_keys, most=config.most_per_key
        )
        taken = [candidate.place for candidate in chosen]
        wider = windows * (config.search_factor, config.search_factor, 1.0)
        chosen += [
            _Candidate(place, between(poses[place], poses[key]), wider[place], windows[place])
            for place in near
            if place not in taken
        ]
        return chosen[: config.most_per_key]

    def _submap(self, scans: Sequence[KeyScan], poses: np.ndarray, place: int) -> _Submap:
        if place in self._submaps:
            self._submaps.move_to_end(place)
            return self._submaps[place]
        half = self.config.submap_keys // 2
        first, after = max(0, place - half), min(len(scans), place - half + self.config.submap_keys)
        local = _between(poses[place], poses[first:after])
        together = placed(scans[first:after], self._profiles[first:after], local)
        submap = self._submap_of(first, local, together)
        self._submaps[place] = submap
        if len(self._submaps) > self.config.most_submaps:
            self._submaps.popitem(last=False)
        return submap

    def _submap_of(self, first: int, local: np.ndarray, together: PlacedScans) -> _Submap:
        lines = line_map_of_points(together.points, together.normals)
        near = _within(together.points, self.config.range_m)
        grid = pooled_grid(self.config.search, near) if len(near) else None
        return _Submap(first, local, together, lines, grid)

    def of_fixed_map(self, scans: Sequence[KeyScan]) -> "ScanLoopFinder":
        """A finder that knows these key scans, and has no loops: where the map stays as it is, others are ``seen``."""
        other = ScanLoopFinder(self.config)
        other._profiles = [*self._profiles, *map(range_profile, scans[len(self._profiles) :])]
        for scan in scans:
            other._middles.append(_middle(scan.points))
        other._forgotten = set(self._forgotten)
        return other

    def source(self, scans: Sequence[KeyScan], odometry: np.ndarray) -> PlacedScans:
        """The newest of some scans at poses ``(scans, 3)``, in the frame of the last: what is searched together."""
        newest = scans[-self.config.source_keys :]
        local = _between(odometry[-1], odometry[-len(newest) :])
        return placed(newest, [range_profile(scan) for scan in newest], local)

    def search_points(self, source: PlacedScans) -> np.ndarray:
        """Some points ``(n, 2)`` of a source, by which it is searched."""
        config = self.config
        return _spread(_within(source.points, config.range_m), config.search.resolution_m, config.search_points)

    def seen(
        self, scans: Sequence[KeyScan], poses: np.ndarray, source: PlacedScans, expected: np.ndarray, window: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Pose ``(3,)`` of a source in a map of key scans, and its covariance ``(3, 3)``; None where a test fails.

        The tests are those of a loop, but for neighbours and the graph's pose. Of the places around, the one is taken
        whose scans look where the source looks: a scanner does not see what is behind it.

        Args:
            scans, poses: all key scans of ``of_fixed_map``, and their poses in the map ``(keys, 3)``.
            expected, window: where to search, and how far to each side ``(3,)`` (m, m, rad).
        """
        known = np.array([k for k in range(len(poses)) if k not in self._forgotten], np.int64)
        view = _views(expected[None], _middle(source.points)[None])
        away = np.linalg.norm(poses[known, :2] - expected[:2], axis=1)
        difference = np.linalg.norm(_views(poses[known], self._middles.values[known]) - view, axis=1)
        place = int(known[(difference + 0.5 * away).argmin()])
        submap = self._submap(scans, poses, place)
        fit = self._fit(submap, source, between(poses[place], expected), window)
        if fit is None or fit.through > self.config.most_seen_through:
            return None
        turned = turned_covariance(poses[place, 2], fit.covariance + _SUBMAP_VARIANCE)
        return compose(poses[place], fit.pose), turned

    def _fit(self, submap: _Submap, source: PlacedScans, centre: np.ndarray, window: np.ndarray) -> _Fit | None:
        """A source searched in a submap; None where it does not lie on the submap's lines, or elsewhere as well."""
        config, chosen = self.config, self.search_points(source)
        if submap.grid is None or len(chosen) == 0:
            return None
        match = search(config.search, submap.grid, chosen, centre, window)
        if match is None or match.response < config.least_response:
            return None
        second_peak = match.second / match.response
        if second_peak > config.most_second:
            return None
        registered = icp(submap.lines, source.points, source.normals, match.pose)
        if registered.share < config.least_on_lines:
            return None
        through = seen_through(submap.scans, source, registered.pose)
        return _Fit(registered.pose, registered.covariance, match.response, second_peak, registered.share, through)

    def _verified(self, scans: Sequence[KeyScan], poses: np.ndarray, candidate: _Candidate) -> ScanLoops | None:
        """A loop of the last key with the submap of a place, if it passes every test but that of its neighbours."""
        config, key = self.config, len(scans) - 1
        submap = self._submap(scans, poses, candidate.place)
        first = max(0, key + 1 - config.source_keys)
        local = _between(poses[key], poses[first:])
        source = placed(scans[first:], self._profiles[first:], local)
        fit = self._fit(submap, source, candidate.centre, candidate.window)
        if fit is None:
            return None
        off = fit.pose - between(poses[candidate.place], poses[key])
        off[2] = wrap(off[2])
        disagreement = float(np.linalg.norm(3.0 * off / candidate.likely))
        if fit.through > config.most_seen_through or disagreement > config.most_disagreement:
            return None
        # From the nearest of the submap's keys: its pose in the submap is the least uncertain.
        nearest = int(np.argmin(np.linalg.norm(submap.poses[:, :2] - fit.pose[:2], axis=1)))
        earlier = submap.poses[nearest]
        covariance = turned_covariance(-earlier[2], fit.covariance) + _SUBMAP_VARIANCE
        return ScanLoops(
            np.array(((submap.first + nearest, key),)),
            between(earlier, fit.pose)[None],
            covariance[None],
            np.array(((fit.response, fit.second_peak, fit.on_lines, fit.through, disagreement, 0.0),)),
            np.zeros(1, bool),
        )

    def _agreed(self, found: ScanLoops, poses: np.ndarray) -> np.ndarray:
        """Count agreeing neighbours of new loops and of old ones near them; keep all, return which became accepted."""
        if len(found) == 0:
            return np.zeros(0, np.int64)
        config, old = self.config, len(self.loops)
        loops = self.loops.extended(found)
        pairs, evidence = loops.pairs, loops.evidence.copy()
        for k in range(old, len(loops)):
            gap = np.abs(pairs[:old] - pairs[k])
            near = np.flatnonzero((gap <= config.neighbour_keys).all(1) & (gap[:, 1] > 0))
            if len(near) == 0:
                continue
            # The way from the earlier key of this loop over the other loop to this loop's later key.
            to_earlier = _between_rows(poses[np.full(len(near), pairs[k, 0])], poses[pairs[near, 0]])
            to_later = _between_rows(poses[pairs[near, 1]], poses[np.full(len(near), pairs[k, 1])])
            off = _compose_rows(_compose_rows(to_earlier, loops.relative[near]), to_later) - loops.relative[k]
            turn = np.abs((off[:, 2] + math.pi) % (2.0 * math.pi) - math.pi)
            agree = near[
                (np.linalg.norm(off[:, :2], axis=1) <= config.agreement_m)
                & (turn <= math.radians(config.agreement_deg))
            ]
            evidence[agree, _AGREEING] += 1.0
            evidence[k, _AGREEING] += len(agree)
        needed = np.maximum(config.least_agreeing, config.agreeing_per_deviation * evidence[:, _DISAGREEMENT])
        accepted = evidence[:, _AGREEING] >= needed
        fresh: np.ndarray = np.flatnonzero(accepted & ~loops.accepted)
        self.loops = ScanLoops(pairs, loops.relative, loops.covariance, evidence, accepted)
        return fresh


def _middle(points: np.ndarray) -> np.ndarray:
    """The middle ``(2,)`` of the points around a robot, in its frame."""
    near = _within(points, _NEAR_M)
    return near.mean(0) if len(near) else np.zeros(2)


def _views(poses: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Where robots at poses ``(n, 3)`` look: the middles ``(n, 2)`` of their points, in the map."""
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, :2] + np.stack(
        (cosine * middles[:, 0] - sine * middles[:, 1], sine * middles[:, 0] + cosine * middles[:, 1]), axis=1
    )


def _within(points: np.ndarray, range_m: float) -> np.ndarray:
    """The points ``(n, 2)`` within a range of the origin."""
    near: np.ndarray = points[(points**2).sum(1) <= range_m**2]
    return near


def _spread(points: np.ndarray, cell_m: float, most: int) -> np.ndarray:
    """One point ``(n, 2)`` of each cell, and of these every so many that at most ``most`` remain."""
    row, column = np.floor(points / cell_m).astype(np.int64).T
    _, first = np.unique((row << 32) + column, return_index=True)
    chosen = points[np.sort(first)]
    return chosen[np.linspace(0, len(chosen) - 1, most).astype(np.int64)] if len(chosen) > most else chosen


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses ``(n, 3)`` seen from one pose ``(3,)``."""
    return _between_rows(np.broadcast_to(a, b.shape), b)


def _between_rows(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(a[:, 2]), np.sin(a[:, 2])
    x, y = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    turn = (b[:, 2] - a[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
    return np.stack((cosine * x + sine * y, cosine * y - sine * x, turn), axis=-1)


def _compose_rows(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(a[:, 2]), np.sin(a[:, 2])
    x, y = a[:, 0] + cosine * b[:, 0] - sine * b[:, 1], a[:, 1] + sine * b[:, 0] + cosine * b[:, 1]
    return np.stack((x, y, a[:, 2] + b[:, 2]), axis=-1)
