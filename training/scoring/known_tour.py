"""The tour of a robot that knows the map: a short way on which the share that is asked for is seen.

The watchman's route with a quota. Stops are inserted where they show most a metre, what the way between stops shows
counted; the tour is shortened by 2-opt and or-opt, and then parts of it are dropped and filled again while that makes
it shorter (large neighbourhood search, Shaw 1998). It is no proof: the best tour may still be a little shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ngo_estimator.mapping.range_scan import RangeScan
from ngo_explorer.known_map import KnownMap
from ngo_explorer.planner import cost_field, line_is_free, plan_path

_CELL_M = 0.25  # of what places see
_JOINED_M = 0.75  # places this near are neighbours, if the way is free
_MOST_STOPS = 1000  # places among which stops are chosen
_SHARE = 0.955  # of the cells: 95 % with a margin for their size
_ROUNDS = 200


@dataclass(frozen=True, eq=False)
class Sights:
    """Places and what they show.

    ``seen`` bool ``(places, cells)``; ``stops`` ``(n,)`` the places among which a tour chooses, the start first;
    ``ways_m`` ``(n, places)`` from each stop, infinite where no way leads, and ``before`` the place before on that way.
    """

    seen: np.ndarray
    stops: np.ndarray
    ways_m: np.ndarray
    before: np.ndarray

    def passed(self, tour_stops: list[int]) -> list[int]:
        """All places along the way from stop to stop, the start first."""
        places = [int(self.stops[tour_stops[0]])]
        for one, other in zip(tour_stops[:-1], tour_stops[1:], strict=True):
            leg, at = [], int(self.stops[other])
            while at != self.stops[one]:
                leg.append(at)
                at = int(self.before[one, at])
            places += leg[::-1]
        return places

    def shown(self, tour_stops: list[int]) -> np.ndarray:
        """Which cells the tour shows."""
        return np.asarray(self.seen[self.passed(tour_stops)].any(axis=0))

    def length_m(self, tour_stops: list[int]) -> float:
        """Length of the way from stop to stop."""
        return float(self.ways_m[tour_stops[:-1], self.stops[tour_stops[1:]]].sum())


def known_tour(
    scans: Sequence[RangeScan], poses: np.ndarray, known: KnownMap, start_xy: np.ndarray, need_m: float
) -> list[np.ndarray]:
    """Paths ``(n, 2)`` from place to place, in order; all that is asked for is seen at the end of the last.

    scans: exact ones, from ``poses`` ``(n, 3)`` all over where the robot can go.
    """
    field = cost_field(known, start_xy, need_m)
    rows, columns = known.cells(poses[:, :2]).T // known.block
    near = np.flatnonzero(field[rows, columns] >= 0).tolist()
    points = np.concatenate((start_xy[None], poses[near, :2]))
    nearest = 1 + int(np.argmin(np.hypot(*(points[1:] - start_xy).T)))
    seen = _seen([scans[number].ends + poses[number, :2] for number in near], points[1:])
    sights = _sights(known, points, np.concatenate((seen[nearest - 1][None], seen)), nearest, need_m)
    paths, at = [], start_xy
    for stop in shortest_tour(sights, _SHARE * float(seen.any(axis=0).sum()), _ROUNDS)[1:]:
        goal = points[sights.stops[stop]]
        path = plan_path(known, cost_field(known, at, need_m), at, goal, need_m)
        if path is not None:
            paths.append(path)
            at = path[-1]
    return paths


def shortest_tour(sights: Sights, cells: float, rounds: int) -> list[int]:
    """The stops in order, the start first, on whose way so many cells are seen."""
    rng = np.random.default_rng(0)
    best = _tidied(sights, _filled(sights, [0], cells), cells)
    for _ in range(rounds):
        size = int(rng.integers(1, 2 + max(1, len(best) // 3)))
        begin = int(rng.integers(1, max(2, len(best) - size + 1)))
        tried = _tidied(sights, _filled(sights, best[:begin] + best[begin + size :], cells, rng), cells)
        if sights.length_m(tried) < sights.length_m(best) - 1e-6:
            best = tried
    return best


def in_order(first_m: np.ndarray, between_m: np.ndarray) -> np.ndarray:
    """The order ``(n,)`` of the shortest way that is found over n places; first_m: ``(n,)`` ways from the start."""
    return np.asarray(_improved(_inserted(first_m, between_m), first_m, between_m))


def _filled(sights: Sights, order: list[int], cells: float, rng: np.random.Generator | None = None) -> list[int]:
    """Insert the stops that show most a metre until enough is seen; by ``rng`` not always the very best."""
    order, shown = list(order), sights.shown(order)
    between = sights.ways_m[:, sights.stops]
    own = sights.seen[sights.stops].astype(np.float32)
    while shown.sum() < cells:
        gains = own @ (~shown).astype(np.float32)
        extra = between[order] + np.concatenate((between[order[1:]], np.zeros((1, len(gains)))))
        extra[:-1] -= between[order[:-1], order[1:]][:, None]
        worth = gains / (extra.min(axis=0) + _CELL_M)
        worth *= 1.0 if rng is None else rng.uniform(0.7, 1.0, len(worth))
        stop = int(np.argmax(worth))
        if not worth[stop] > 0.0:
            break
        order.insert(int(np.argmin(extra[:, stop])) + 1, stop)
        shown = sights.shown(order)
    return order


def _tidied(sights: Sights, order: list[int], cells: float) -> list[int]:
    """The stops in the shortest order that is found, without those that are not needed."""
    between = sights.ways_m[:, sights.stops]
    if len(order) > 2:
        inner = np.array(order[1:])
        ordered = [0, *inner[in_order(between[0, inner], between[np.ix_(inner, inner)])].tolist()]
        if sights.length_m(ordered) < sights.length_m(order) and sights.shown(ordered).sum() >= cells:
            order = ordered
    for stop in order[:0:-1]:
        fewer = [other for other in order if other != stop]
        if sights.shown(fewer).sum() >= cells:
            order = fewer
    return order


def _sights(known: KnownMap, points: np.ndarray, seen: np.ndarray, nearest: int, need_m: float) -> Sights:
    """Places with the ways between them; the start is joined with the place nearest to it."""
    pairs = cKDTree(points).query_pairs(_JOINED_M, output_type="ndarray")
    free = [line_is_free(known, points[one], points[other], need_m) for one, other in pairs]
    pairs = np.concatenate((pairs[np.array(free, np.bool_)], [[0, nearest]]))
    lengths = np.maximum(np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T), 1e-6)
    graph = coo_array((lengths, tuple(pairs.T)), shape=(len(points),) * 2).tocsr()
    stops = np.arange(0, len(points), max(1, len(points) // _MOST_STOPS))
    ways, before = dijkstra(graph, directed=False, indices=stops, return_predecessors=True)
    reached = np.isfinite(ways[0, stops])
    return Sights(seen, stops[reached], ways[reached], before[reached])


def _seen(ends: list[np.ndarray], points: np.ndarray) -> np.ndarray:
    """Which cells are seen from each point: bool ``(points, cells)`` of the cells seen from anywhere."""
    numbers = [_cells(point, some) for point, some in zip(points, ends, strict=True)]
    cells, inverse = np.unique(np.concatenate(numbers), return_inverse=True)
    rows = np.repeat(np.arange(len(points)), [len(some) for some in numbers])
    seen = np.zeros((len(points), len(cells)), np.bool_)
    seen[rows, inverse] = True
    return seen


def _cells(point: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Numbers of the cells that rays from a point to ``ends`` ``(n, 2)`` go through."""
    away = ends - point
    lengths = np.hypot(*away.T)
    steps = np.arange(0.0, max(float(lengths.max()), _CELL_M), _CELL_M)
    places = point + away[:, None] / np.maximum(lengths, 1e-6)[:, None, None] * steps[:, None]
    at = np.floor(places[steps < lengths[:, None]] / _CELL_M).astype(np.int64)
    return np.unique(at[:, 1] * 1_000_000 + at[:, 0])


@njit(cache=True)
def _inserted(first: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Nearest insertion: the place nearest to the tour so far enters where it costs least."""
    count = len(first)
    order = np.empty(count, np.int64)
    order[0] = int(np.argmin(first))
    inside = np.zeros(count, np.bool_)
    inside[order[0]] = True
    gaps = between[order[0]].copy()
    for filled in range(1, count):
        chosen = -1
        for place in range(count):
            if not inside[place] and (chosen < 0 or gaps[place] < gaps[chosen]):
                chosen = place
        best, position = np.inf, filled
        for at in range(filled + 1):
            before = first[chosen] if at == 0 else between[order[at - 1], chosen]
            if at == filled:
                more = before
            else:
                after = order[at]
                more = before + between[chosen, after] - (first[after] if at == 0 else between[order[at - 1], after])
            if more < best:
                best, position = more, at
        order[position + 1 : filled + 1] = order[position:filled].copy()
        order[position] = chosen
        inside[chosen] = True
        gaps = np.minimum(gaps, between[chosen])
    return order


@njit(cache=True)
def _length(order: np.ndarray, first: np.ndarray, between: np.ndarray) -> float:
    total = first[order[0]]
    for index in range(1, len(order)):
        total += between[order[index - 1], order[index]]
    return total


@njit(cache=True)
def _improved(order: np.ndarray, first: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Reverse and move parts of the tour while that makes it shorter."""
    count, rounds, changed = len(order), 0, True
    best = _length(order, first, between)
    while changed and rounds < 50:
        changed = False
        rounds += 1
        for begin in range(count - 1):
            for end in range(begin + 1, count):
                tried = order.copy()
                tried[begin : end + 1] = order[begin : end + 1][::-1]
                length = _length(tried, first, between)
                if length < best - 1e-9:
                    order[:] = tried
                    best, changed = length, True
        for size in range(1, min(4, count)):
            for begin in range(count - size + 1):
                for target in range(count - size + 1):
                    if target == begin:
                        continue
                    rest = np.concatenate((order[:begin], order[begin + size :]))
                    tried = np.concatenate((rest[:target], order[begin : begin + size], rest[target:]))
                    length = _length(tried, first, between)
                    if length < best - 1e-9:
                        order[:] = tried
                        best, changed = length, True
    return order
