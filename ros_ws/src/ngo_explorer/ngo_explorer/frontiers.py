"""Frontiers: connected edges of the unknown (Yamauchi 1997), where each is seen from, and what it shows there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_explorer.known_map import Cells, Floats, KnownMap

_DIRECTIONS = 48
_SAMPLES = 5  # cells of a frontier from which viewpoints are looked for
_NEAR_M = 0.7  # a viewpoint nearer than this to its frontier is no better
_VIEWPOINTS, _APART_M = 8, 0.5  # that are compared by their gain, and how far they are apart
_BARRED_M = 0.4
_FAR_COST = 2.0  # metres of path that a metre more between viewpoint and frontier is worth

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Frontier:
    """An edge of the unknown. ``points_xy`` ``(n, 2)`` are the middles of its cells, ``point_xy`` ``(2,)`` one (m)."""

    points_xy: Floats
    point_xy: Floats
    size_m: float


@dataclass(frozen=True, eq=False)
class Candidate:
    """A frontier that can be seen from where the robot can go.

    ``viewpoint_xy`` ``(2,)`` is the middle of a cell, ``way_m`` the cost of the path there in metres of easy path, and
    ``gain_m2`` the unknown area that may be seen from there.
    """

    frontier: Frontier
    viewpoint_xy: Floats
    way_m: float
    gain_m2: float

    @property
    def yaw(self) -> float:
        """Direction from the viewpoint to the frontier."""
        x, y = self.frontier.point_xy - self.viewpoint_xy
        return math.atan2(y, x)


class FrontierFinder:
    """Finds connected frontiers; ``piece_m`` is the length of the longest, which longer ones are cut to.

    With ``by_cells`` their length is their number of cells times the resolution, as explore_lite has it. This is up to
    1.4 times too short where they lie across the grid. ``short_xy`` ``(n, 2)`` is a cell of each that is
    shorter than ``least_m``, of the last map.
    """

    def __init__(self, least_m: float, piece_m: float, by_cells: bool = False) -> None:
        self._least_m, self._piece_m, self._by_cells = least_m, piece_m, by_cells
        self._labels = np.zeros(0, np.int32)
        self.short_xy = np.zeros((0, 2))

    def find(self, known: KnownMap) -> list[Frontier]:
        """All frontiers of a map that are long enough."""
        cells = known.frontier_cells()
        if len(self._labels) != known.frontier.size:
            self._labels = np.zeros(known.frontier.size, np.int32)
        longest = int(min(self._piece_m / known.resolution_m, 2**31 - 1))
        order, starts = _connected(cells, known.frontier, self._labels, max(1, longest))
        cells = np.stack(np.divmod(order, known.frontier.shape[1]), axis=1)
        firsts, sizes = starts[:-1], np.diff(starts).astype(np.float64)
        if len(order) and not self._by_cells:
            spans = np.maximum.reduceat(cells, firsts) - np.minimum.reduceat(cells, firsts)
            sizes = np.maximum(sizes, np.hypot(*spans.T) + 1.0)
        sizes *= known.resolution_m
        found, long = [], sizes >= self._least_m
        for index in np.flatnonzero(long).tolist():
            at = cells[starts[index] : starts[index + 1]]
            points, middle = known.points(at), np.argmin(np.sum((at - at.mean(axis=0)) ** 2, axis=1))
            found.append(Frontier(points, points[middle], float(sizes[index])))
        self.short_xy = known.points(cells[firsts[~long]])
        return found


def viewpoint(
    known: KnownMap,
    frontier: Frontier,
    field: NDArray[np.int32],
    need_m: float,
    reach_m: float,
    range_m: float,
    barred: Floats,
) -> tuple[Floats, float, float] | None:
    """Where a frontier is best seen from: the point ``(2,)``, the cost of the way there in m, and the gain in m^2.

    Of places that show at least half of the largest gain it is the one with the shortest way. None where no place is.
    field: costs of the blocks from `planner.cost_field`. barred: ``(n, 2)`` points that are no viewpoints any more.
    """
    count = len(frontier.points_xy)
    picks = frontier.points_xy[np.linspace(0, count - 1, min(_SAMPLES, count)).astype(np.int64)]
    found, costs = _viewpoints(
        known.state,
        known.clearance_m,
        field,
        known.block,
        known.cells(picks) @ (known.state.shape[1], 1),
        need_m,
        known.resolution_m,
        reach_m,
        known.cells(barred),
    )
    if not len(found):
        return None
    points = known.points(found)
    gaps = np.hypot(*(points - frontier.point_xy).T)
    gains = gains_m2(known, points, gaps + range_m)
    best = int(np.flatnonzero(gains >= 0.5 * gains.max())[0])
    return points[best], float(costs[best]), float(gains[best])


def gains_m2(known: KnownMap, points_xy: Floats, ranges_m: Floats) -> Floats:
    """``(n,)`` unknown area that rays from points ``(n, 2)`` may see: up to obstacles and to the range ``(n,)``."""
    return np.asarray(_gains(known.state, known.cells(points_xy), known.resolution_m, ranges_m))


@njit(cache=True)
def _connected(cells: Ints, frontier: NDArray[np.bool_], labels: NDArray[np.int32], longest: int) -> tuple[Ints, Ints]:
    """Cells by frontier, and where each begins. ``labels`` is zero, and is so afterwards."""
    rows, columns = frontier.shape
    order = np.empty(len(cells), np.int64)
    starts = [0]
    filled = 0
    for first in cells:
        if labels[first] != 0:
            continue
        begin = filled
        labels[first] = 1
        order[filled] = first
        filled += 1
        head = begin
        while head < filled and filled - begin < longest:
            cell = order[head]
            head += 1
            row, column = cell // columns, cell % columns
            for r in range(max(0, row - 1), min(rows, row + 2)):
                for c in range(max(0, column - 1), min(columns, column + 2)):
                    other = r * columns + c
                    if frontier[r, c] and labels[other] == 0 and filled - begin < longest:
                        labels[other] = 1
                        order[filled] = other
                        filled += 1
        starts.append(filled)
    for cell in cells:
        labels[cell] = 0
    return order, np.array(starts)


@njit(cache=True)
def _viewpoints(
    state: Cells,
    clearance: NDArray[np.float32],
    field: NDArray[np.int32],
    block: int,
    cells: Ints,
    need: float,
    resolution: float,
    reach: float,
    barred: Ints,
) -> tuple[Ints, Floats]:
    """Cells ``(n, 2)`` that see one of ``cells``, the best first and some way apart, and the costs to get there."""
    rows, columns = state.shape
    unit = block * resolution / 10.0
    most = len(cells) * _DIRECTIONS * int(reach / resolution)
    places = np.empty((most, 2), np.int64)
    scores, ways = np.empty(most), np.empty(most)
    count = 0
    for cell in cells:
        row, column = cell // columns, cell % columns
        for direction in range(_DIRECTIONS):
            dy, dx = math.sin(direction * math.tau / _DIRECTIONS), math.cos(direction * math.tau / _DIRECTIONS)
            for step in range(int(reach / resolution)):
                r, c = math.floor(row + 0.5 + step * dy), math.floor(column + 0.5 + step * dx)
                if r < 0 or c < 0 or r >= rows or c >= columns or state[r, c] != 0:
                    break
                cost = field[r // block, c // block]
                if clearance[r, c] < need or cost < 0:
                    continue
                places[count, 0], places[count, 1], ways[count] = r, c, cost * unit
                scores[count] = cost * unit + _FAR_COST * max(0.0, step * resolution - _NEAR_M)
                count += 1
    for index in range(count):
        for other in range(len(barred)):
            away = (places[index, 0] - barred[other, 0]) ** 2 + (places[index, 1] - barred[other, 1]) ** 2
            if away * resolution * resolution < _BARRED_M**2:
                scores[index] = np.inf
    chosen = np.empty(_VIEWPOINTS, np.int64)
    filled = 0
    while filled < _VIEWPOINTS and count > 0:
        best = int(np.argmin(scores[:count]))
        if scores[best] == np.inf:
            break
        chosen[filled] = best
        filled += 1
        for index in range(count):
            away = (places[index, 0] - places[best, 0]) ** 2 + (places[index, 1] - places[best, 1]) ** 2
            if away * resolution * resolution < _APART_M**2:
                scores[index] = np.inf
    return places[chosen[:filled]], ways[chosen[:filled]]


@njit(cache=True)
def _gains(state: Cells, cells: Ints, resolution: float, reaches: Floats) -> Floats:
    rows, columns = state.shape
    areas = np.zeros(len(cells))
    for index in range(len(cells)):
        row, column = cells[index]
        for ray in range(_DIRECTIONS):
            angle = (ray + 0.5) * math.tau / _DIRECTIONS
            dy, dx = math.sin(angle), math.cos(angle)
            for step in range(1, int(reaches[index] / resolution)):
                r, c = math.floor(row + 0.5 + step * dy), math.floor(column + 0.5 + step * dx)
                inside = 0 <= r < rows and 0 <= c < columns
                if inside and state[r, c] == 1:
                    break
                if not inside or state[r, c] == -1:
                    areas[index] += step * resolution * resolution * math.tau / _DIRECTIONS
    return areas
