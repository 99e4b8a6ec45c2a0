"""How a stretch of the way agrees with a place of the map: evidence for, or against, that both are the same.

Scans that fit say little: a corridor with a corner is in every building. What counts is how many different walls both
have, and whether either looks through walls of the other, anywhere on the stretch and not only where scans fit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.loops.key_scan_views import KeyScanViews, one_a_cell
from ngo_estimator.loops.walls_seen_through import PlacedScans, placed, sightings

_CELL_M = 0.15
"""Of the points in a cell of this side one counts."""

_THICK_M, _PARALLEL = 0.1, 0.95
"""Points of one straight wall: how far from its line, and the cosine between their normals at least."""

_WALL_POINTS = 4
"""Points, one a cell, that make a wall."""

STRETCH_M, _PART = 20.0, 4
"""The way that is compared at most, and of how many key scans a part of it is."""

NEAR_M, MOST_SCANS = 8.0, 60
"""The key scans that it is compared with: how far from it, and how many at most."""

_MOST_POINTS = 2000
"""Points at most that are compared with each other."""

_SAID = 40
"""Sightings from which on their share says something."""

_LEAST_WALLS, _MOST_MEAN, _OWN_TIMES = 8, 0.02, 4.5
"""A claim needs so many different walls. The way may look through so much of the walls in the mean, and so many times
as much as the place's own scans do: where people walk, and doors and furniture move, a map contradicts itself."""

_MOST_EVER = 0.3
"""However much it does: a wrong join makes a map that contradicts itself, and must not let in the next one. A claim is
taken back above 0.35; right places of real logs look through up to 0.16, their maps through 0.06."""

_FEWEST_WALLS = 4
"""So many walls tell places apart where nothing is looked through, and the more is, the more walls it takes."""


@dataclass(frozen=True)
class PlaceEvidence:
    """``walls``: different straight walls that both see, where they were counted.

    ``said``: whether some part of the stretch has sightings enough for a share. ``seen``: all sightings, and
    ``mean``: the share of those of them that go through walls, and ``own`` that of the place's scans among each other.
    ``overlap``: the share of points of one side that the other one sees, or sees through.
    """

    walls: int
    said: bool = False
    seen: int = 0
    mean: float = 0.0
    overlap: float = 0.0
    own: float = 0.0

    @property
    def _most(self) -> float:
        """Of ``mean`` at the place of the way."""
        return min(_MOST_MEAN + _OWN_TIMES * self.own, _MOST_EVER)

    @property
    def suffices(self) -> bool:
        """Whether a stretch of the way and a place have enough in common, and contradict each other little."""
        return self.walls >= _LEAST_WALLS and self.mean <= self._most

    def rivals(self, better: "PlaceEvidence") -> bool:
        """Whether this suffices, or is nearly as likely as a better place: the way looks through less than twice as
        much."""
        return self.walls >= _LEAST_WALLS and self.mean <= max(self._most, 2.0 * better.mean)

    @property
    def is_clear(self) -> bool:
        """Whether they have enough in common for how little they contradict each other."""
        needed = _FEWEST_WALLS + (_LEAST_WALLS - _FEWEST_WALLS) * self.mean / self._most
        return bool(self.walls >= needed and self.mean <= self._most)


NO_EVIDENCE = PlaceEvidence(0)
"""Of a stretch that comes nowhere near the place."""


def evidence_of(
    scans: Sequence[KeyScan],
    views: KeyScanViews,
    stretch: tuple[np.ndarray, np.ndarray],
    others: tuple[np.ndarray, np.ndarray],
    most_scans: int = MOST_SCANS,
    count_walls: bool = False,
) -> PlaceEvidence:
    """How the key scans of a stretch agree with those of others near it; both are keys and their poses ``(n, 3)``.

    Of the others ``most_scans`` are compared.
    """

    keys, at = stretch

    def part(which: slice) -> PlacedScans:
        chosen = keys[which].tolist()
        return placed([scans[key] for key in chosen], [views.profiles[key] for key in chosen], at[which])

    return evidence_at(scans, views, (at, part), others, most_scans, count_walls)


def evidence_at(
    scans: Sequence[KeyScan],
    views: KeyScanViews,
    stretch: tuple[np.ndarray, Callable[[slice], PlacedScans]],
    others: tuple[np.ndarray, np.ndarray],
    most_scans: int = MOST_SCANS,
    count_walls: bool = False,
) -> PlaceEvidence:
    """The same of a stretch whose scans are not among ``scans``: its poses ``(n, 3)``, and what gives some of them."""
    at, part = stretch
    near = np.flatnonzero(_near(others[1], at))
    near = near[:: max(1, -(-len(near) // most_scans))]
    if not len(near):
        return NO_EVIDENCE
    chosen = others[0][near].tolist()
    place = placed([scans[key] for key in chosen], [views.profiles[key] for key in chosen], others[1][near])
    parts = [part(slice(first, first + _PART)) for first in range(0, len(at), _PART)]
    return place_evidence(place, parts, count_walls)


def last_stretch(poses: np.ndarray, first: int, most_m: float = STRETCH_M) -> np.ndarray:
    """The keys from ``first`` on that lie on the last ``most_m`` of the way of poses ``(keys, 3)``."""
    to_end = np.cumsum(np.hypot(*np.diff(poses[first:, :2], axis=0)[::-1].T))
    return np.arange(len(poses) - 1 - int(np.searchsorted(to_end, most_m)), len(poses))


def place_evidence(place: PlacedScans, stretch: Sequence[PlacedScans], count_walls: bool = True) -> PlaceEvidence:
    """The evidence of the parts of a stretch, each of some scans, in the frame of the place's scans."""
    counts, possible = [], 1
    place, own = _steady(_thinned(place))
    points, normals = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for part in map(_thinned, stretch):
        ours = sightings(place.sensors, place.profiles, part.points)
        its = sightings(part.sensors, part.profiles, place.points)
        agree = ours[:, 1] > ours[:, 0]
        points.append(part.points[agree])
        normals.append(part.normals[agree])
        counts += [ours.sum(0), its.sum(0)]
        possible += len(place.sensors) * len(part.points) + len(part.sensors) * len(place.points)
    walls = distinct_walls(np.concatenate(points), np.concatenate(normals)) if count_walls else 0
    # A wall that one side alone has is seen through by the other alone.
    said = any(count.sum() >= _SAID for count in counts)
    through, on = np.sum([(0, 0), *counts], axis=0).tolist()
    seen = through + on
    return PlaceEvidence(walls, said, seen, through / max(1, seen), seen / possible, own)


def distinct_walls(points: np.ndarray, normals: np.ndarray) -> int:
    """How many straight walls explain points ``(n, 2)`` that have normals ``(n, 2)``, those without one left out."""
    known = (normals**2).sum(1) > 0.5
    points, normals = points[known], normals[known]
    one = one_a_cell(points, _CELL_M)
    one = one[:: max(1, -(-len(one) // _MOST_POINTS))]
    points, normals = points[one], normals[one]
    off = np.abs(normals @ points.T - (normals * points).sum(1)[:, None])
    on = (off <= _THICK_M) & (np.abs(normals @ normals.T) >= _PARALLEL)
    walls = 0
    while len(on) and (support := on.sum(1)).max() >= _WALL_POINTS:
        walls += 1
        left = ~on[support.argmax()]
        on = on[np.ix_(left, left)]
    return walls


def _thinned(scans: PlacedScans) -> PlacedScans:
    one = one_a_cell(scans.points, _CELL_M)
    return replace(scans, points=scans.points[one], normals=scans.normals[one])


def _steady(scans: PlacedScans) -> tuple[PlacedScans, float]:
    """Without points that the same scans mostly see through, of people, and the share of the others that they do."""
    seen = sightings(scans.sensors, scans.profiles, scans.points)
    stays = seen[:, 1] > seen[:, 0]
    through, on = seen[stays].sum(0).tolist()
    steady = replace(scans, points=scans.points[stays], normals=scans.normals[stays])
    return steady, through / max(1, through + on)


@njit(cache=True)
def _near(poses: np.ndarray, stretch: np.ndarray) -> np.ndarray:
    """Which poses ``(n, 3)`` are near one of a stretch ``(m, 3)``."""
    result = np.zeros(len(poses), np.bool_)
    for k in range(len(poses)):
        for i in range(len(stretch)):
            x, y = poses[k, 0] - stretch[i, 0], poses[k, 1] - stretch[i, 1]
            if x * x + y * y < NEAR_M * NEAR_M:
                result[k] = True
                break
    return result
