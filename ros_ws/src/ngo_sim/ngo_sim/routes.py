"""Where a disc can drive in a floor plan, and smooth paths between two points that keep off the walls."""

from __future__ import annotations

import heapq
import math

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import label, uniform_filter1d
from scipy.spatial import cKDTree

from ngo_sim.convex_shapes import Floats
from ngo_sim.floor_plans import FloorPlan

CELL_M = 0.1
_COMFORT_M = 0.9  # a path costs more where walls are nearer
_SPACING_M = 0.03
_SLACK_M = 0.04  # for robots that cut corners
_PATH_STEP_M = 0.05


class RouteMap:
    """Clearance of a floor plan on a grid of 0.1 m, with every door in all its positions counted as an obstacle.

    clearance_m: float64 (rows, columns), distance from a cell's middle to the nearest obstacle, at most 1 m.
    safe: bool (rows, columns), cells in which a disc of radius_m touches nothing, wherever in the cell its middle is.
    area: the cells that paths use: safe, with some slack, and joined. goals_m: (g, 2) the plan's goals within it.
    """

    def __init__(self, plan: FloorPlan, radius_m: float) -> None:
        if not 0.05 <= radius_m <= 0.3:
            raise ValueError(f"radius_m is {radius_m!r}; it must be from 0.05 to 0.3")
        width, height = plan.size_m
        self._shape = (math.ceil(height / CELL_M), math.ceil(width / CELL_M))
        angles = np.linspace(0.0, math.tau, 48, endpoint=False)
        rim = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        obstacles = [_along(plan.segments_m)]
        obstacles.append((plan.circles_m[:, None, :2] + plan.circles_m[:, None, 2:] * rim).reshape(-1, 2))
        doors = plan.doors
        low, high = doors.angles_rad.min(axis=1), doors.angles_rad.max(axis=1)
        low = np.where(doors.passable, low, 0.0)  # the others may be shut at any time
        swept = low + np.linspace(0.0, 1.0, 60)[:, None] * (high - low)
        obstacles.append(_along(doors.leaves_at(swept).reshape(-1, 4)))
        rows, columns = np.indices(self._shape).reshape(2, -1)
        middles = (np.stack((columns, rows), axis=1) + 0.5) * CELL_M
        gaps, _ = cKDTree(np.concatenate(obstacles)).query(middles, distance_upper_bound=1.0)
        self.clearance_m = np.minimum(gaps, 1.0).reshape(self._shape)
        # Half a cell's diagonal, and half the distance between two points of an obstacle.
        self.safe = self.clearance_m >= radius_m + CELL_M * math.sqrt(0.5) + _SPACING_M / 2
        roomy = self.clearance_m >= radius_m + CELL_M * math.sqrt(0.5) + _SPACING_M / 2 + _SLACK_M
        areas, _ = label(roomy, np.ones((3, 3)))
        inside = self._cells(plan.goals_m)
        marks = areas[inside[:, 0], inside[:, 1]]
        if not marks.any():
            raise ValueError(f"a robot of {radius_m} m has no place in this floor plan; it must be smaller")
        main = np.bincount(marks[marks > 0]).argmax()
        self.area = areas == main
        self.goals_m = plan.goals_m[marks == main]

    def path(self, start_xy: npt.ArrayLike, goal_xy: npt.ArrayLike) -> Floats:
        """(n, 2) points some 5 cm apart from the cell of start to goal, smooth where the walls let it.

        Raises ValueError where no way joins the two.
        """
        start, goal = (self._nearest(np.asarray(point, dtype=np.float64)) for point in (start_xy, goal_xy))
        cells = _a_star(self.clearance_m, self.area, start, goal)
        if not len(cells):
            raise ValueError(f"no way joins {start_xy!r} and {goal_xy!r}")
        points = (cells[:, ::-1].astype(np.float64) + 0.5) * CELL_M
        for window in (15, 9, 5, 3):
            smooth = np.asarray(uniform_filter1d(points, window, axis=0, mode="nearest"))
            smooth[0], smooth[-1] = points[0], points[-1]
            row, col = self._cells(smooth).T
            if self.area[row, col].all():
                points = smooth
                break
        return _resampled(points)

    def _nearest(self, point: Floats) -> tuple[int, int]:
        """The free cell nearest to a point, within half a metre."""
        row, col = self._cells(point[None])[0].tolist()
        reach = 5
        low_row, low_col = max(0, row - reach), max(0, col - reach)
        around = np.argwhere(self.area[low_row : row + reach + 1, low_col : col + reach + 1])
        if not len(around):
            raise ValueError(f"the point {np.round(point, 2)} m is in a wall or out of reach")
        around += (low_row, low_col)
        nearest = around[np.argmin(np.sum((around - (row, col)) ** 2, axis=1))]
        return int(nearest[0]), int(nearest[1])

    def _cells(self, points: Floats) -> npt.NDArray[np.int64]:
        cells = (points[:, ::-1] / CELL_M).astype(np.int64)
        return np.clip(cells, 0, np.array(self._shape) - 1)


def _along(segments: Floats) -> Floats:
    """(n, 2) points along segments, dense enough to leave no cell out by more than half the spacing."""
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    counts = np.ceil(lengths / _SPACING_M).astype(np.int64) + 1
    owner = np.repeat(np.arange(len(segments)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (place / np.maximum(counts[owner] - 1, 1))[:, None]
    return segments[owner, :2] * (1 - share) + segments[owner, 2:] * share


def _resampled(points: Floats) -> Floats:
    steps = np.hypot(*np.diff(points, axis=0).T)
    reached = np.concatenate(((0.0,), np.cumsum(steps)))
    even = np.linspace(0.0, reached[-1], max(2, int(reached[-1] / _PATH_STEP_M)))
    return np.stack([np.interp(even, reached, axis) for axis in points.T], axis=1)


@njit(cache=True)
def _a_star(
    clearance: Floats, area: npt.NDArray[np.bool_], start: tuple[int, int], goal: tuple[int, int]
) -> npt.NDArray[np.int64]:
    """(n, 2) cells row, column of the cheapest way, none where there is no way."""
    rows, columns = area.shape
    cost = np.full(rows * columns, np.inf)
    parent = np.full(rows * columns, -1, np.int64)
    first, last = start[0] * columns + start[1], goal[0] * columns + goal[1]
    cost[first] = 0.0
    queue = [(0.0, first)]
    done = np.zeros(rows * columns, np.bool_)
    while len(queue) > 0:
        _, cell = heapq.heappop(queue)
        if cell == last:
            break
        if done[cell]:
            continue
        done[cell] = True
        row, col = cell // columns, cell % columns
        for d_row in range(-1, 2):
            for d_col in range(-1, 2):
                r, c = row + d_row, col + d_col
                if not (0 <= r < rows and 0 <= c < columns) or not area[r, c]:
                    continue
                step = np.sqrt(d_row * d_row + d_col * d_col) * (1.0 + 3.0 * max(0.0, _COMFORT_M - clearance[r, c]))
                after = r * columns + c
                if cost[cell] + step < cost[after]:
                    cost[after] = cost[cell] + step
                    parent[after] = cell
                    left = np.hypot(r - goal[0], c - goal[1])
                    heapq.heappush(queue, (cost[after] + left, after))
    if not np.isfinite(cost[last]):
        return np.zeros((0, 2), np.int64)
    cells = []
    cell = last
    while cell >= 0:
        cells.append((cell // columns, cell % columns))
        cell = parent[cell]
    way = np.empty((len(cells), 2), np.int64)
    for index in range(len(cells)):
        way[index] = cells[len(cells) - 1 - index]
    return way
