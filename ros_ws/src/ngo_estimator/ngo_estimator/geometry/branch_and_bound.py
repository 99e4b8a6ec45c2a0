"""Exhaustive search of a scan's pose in a map: the best one of a window, and whether another fits nearly as well.

Not in the paper. Branch and bound over pooled likelihood grids (Hess et al. 2016, section V): a cell of a coarse grid
holds the largest likelihood of a block of fine cells, so that one look-up bounds the response of all poses of a block.
The best block is split first; the first single pose that comes up is the best of the window.
"""

import heapq
import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import KDTree

from ngo_estimator.data.configuration import check, check_positive

_REACH = 3.0
"""Deviations around a point that have a likelihood."""
_NEAR_DEPTH = 4  # of the blocks where a search near places begins: 1.3 m a side where a cell is 8 cm
_WIDEST_CELLS = 4096  # side of a grid: 117 MB, and 205 m where a cell is 5 cm


@dataclass(frozen=True)
class PooledGrid:
    """Likelihoods of a map, and their maxima over blocks.

    ``levels`` ``(depth + 1, rows, columns)``, uint8: cell ``(row, column)`` of level ``h`` holds the maximum over the
    ``2 ** h`` cells from there on in x (columns) and y (rows), 255 for a likelihood of one. ``origin_m`` ``(2,)`` is
    the corner of cell (0, 0), ``resolution_m`` the size of a cell.
    """

    levels: np.ndarray
    origin_m: np.ndarray
    resolution_m: float


@dataclass(frozen=True)
class SearchMatch:
    """The best pose of a window.

    ``pose`` ``(3,)`` is the pose of the points in the map (m, m, rad), ``response`` the mean likelihood of the points
    there, 0 to 1. ``second`` is the largest response at poses that are well separated from the best one, or an upper
    bound of it where the search was cut short. ``second_pose`` ``(3,)`` has that response; None where only the bound
    is known.
    """

    pose: np.ndarray
    response: float
    second: float
    second_pose: np.ndarray | None = None


@dataclass(frozen=True)
class SearchConfig:
    """How finely poses are searched."""

    resolution_m: float = 0.08
    """Size of a cell, and step of positions (m)."""
    heading_step_deg: float = 2.0
    """Step of headings (degrees)."""
    deviation_m: float = 0.1
    """Deviation of a point from the wall it belongs to (m)."""
    depth: int = 6
    """Blocks have up to ``2 ** depth`` cells a side."""
    separation_m: float = 0.8
    """Poses farther than this from the best are well separated (m)."""
    separation_deg: float = 15.0
    """Poses turned by more than this from the best are, too (degrees)."""
    least_response: float = 0.4
    """Responses below this are not distinguished, 0 to 1."""
    least_second: float = 0.7
    """Second peaks below this part of the first are not distinguished, 0 to 1."""
    most_blocks: int = 100_000
    """Blocks after which the search is cut short."""

    def __post_init__(self) -> None:
        check_positive(self, "resolution_m heading_step_deg deviation_m separation_m separation_deg")
        check(self, "depth", "0 to 10", lambda x: 0 <= x <= 10)
        check(self, "most_blocks", "at least 1", lambda x: x >= 1)
        check(self, "least_response", "a share of 0 to below 1", lambda x: 0.0 <= x < 1.0)
        check(self, "least_second", "a share of 0 to 1", lambda x: 0.0 <= x <= 1.0)


def pooled_grid(config: SearchConfig, points: np.ndarray) -> PooledGrid:
    """Likelihood grids of a map's points ``(n, 2)`` (m); raises ``ValueError`` where there are none.

    Points far from the others are left out: one wild range would make a grid that no memory holds.
    """
    if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0:
        raise ValueError(f"points have the shape {points.shape}; expected (n, 2) with at least one point")
    resolution = config.resolution_m
    middle = points[np.argsort(points, axis=0)[len(points) // 2], [0, 1]]
    near = points[(np.abs(points - middle) <= 0.5 * _WIDEST_CELLS * resolution).all(axis=1)]
    points = near if len(near) else points[:1]
    reach = math.ceil(_REACH * config.deviation_m / resolution)
    # A look-up below the first cell is then a look-up of nothing: no block reaches from there to a point.
    before = (1 << config.depth) + reach
    origin = points.min(0) - before * resolution
    columns, rows = (np.ceil((points.max(0) - origin) / resolution)).astype(np.int64) + reach + 1
    levels = np.zeros((config.depth + 1, rows, columns), np.uint8)
    _stamp(levels[0], points - origin, resolution, config.deviation_m, reach)
    for h in range(config.depth):
        step, fine, coarse = 1 << h, levels[h], levels[h + 1]
        coarse[:] = fine
        np.maximum(coarse[:, :-step], fine[:, step:], out=coarse[:, :-step])
        coarse[:-step] = np.maximum(coarse[:-step], coarse[step:])
    return PooledGrid(levels, origin, resolution)


def search(
    config: SearchConfig,
    grid: PooledGrid,
    points: np.ndarray,
    centre: np.ndarray,
    window: np.ndarray,
    near: tuple[np.ndarray, float] | None = None,
) -> SearchMatch | None:
    """Best pose of points ``(n, 2)`` (m) within ``window`` to each side of ``centre``, both ``(3,)`` (m, m, rad).

    Positions and headings are taken on a lattice around ``centre``. A window of pi and more in heading is a full turn.
    With ``near``, places ``(k, 2)`` in the map and a distance (m), positions farther than that from all of the places
    are left out, to a block.
    Returns ``None`` where no response reaches ``least_response``, or the search was cut short before it found the best.
    """
    if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0:
        raise ValueError(f"points have the shape {points.shape}; expected (n, 2) with at least one point")
    if centre.shape != (3,) or window.shape != (3,) or not (np.isfinite(centre).all() and (window >= 0.0).all()):
        raise ValueError(f"centre, window are {centre}, {window}; expected three finite numbers and three from 0 on")
    headings = centre[2] + _heading_offsets(config, float(window[2]))
    cosine, sine = np.cos(headings)[:, None], np.sin(headings)[:, None]
    x = cosine * points[:, 0] - sine * points[:, 1] + (centre[0] - grid.origin_m[0])
    y = sine * points[:, 0] + cosine * points[:, 1] + (centre[1] - grid.origin_m[1])
    cells = np.floor(np.stack((x, y), axis=-1) / grid.resolution_m).astype(np.int32)
    half_x, half_y = (math.floor(w / grid.resolution_m + 1e-9) for w in window[:2])
    apart = config.separation_m / grid.resolution_m
    depth = len(grid.levels) - 1
    while depth > 0 and (1 << depth) > 2 * max(half_x, half_y) + 1:
        depth -= 1
    begin = np.ones([-(-(2 * half + 1) // (1 << depth)) for half in (half_x, half_y)], np.bool_)
    if near is not None:
        depth = min(depth, _NEAR_DEPTH)
        offsets = (near[0] - centre[:2]) / grid.resolution_m + (half_x, half_y)
        begin = _blocks_near(offsets, near[1] / grid.resolution_m, 1 << depth, 2 * half_x + 1, 2 * half_y + 1)
    found = _best_first(
        grid.levels[: depth + 1], cells, headings, half_x, half_y, begin, apart, math.radians(config.separation_deg),
        config.least_response, config.least_second, config.most_blocks,
    )  # fmt: skip
    response, second, best, other = found
    if response < 0.0:
        return None

    def pose(place: tuple[int, int, int]) -> np.ndarray:
        angle, across, up = place
        shift = np.array((across, up)) * grid.resolution_m
        return np.array((centre[0] + shift[0], centre[1] + shift[1], headings[angle]))

    return SearchMatch(pose(best), response, second, None if other[0] < 0 else pose(other))


def _heading_offsets(config: SearchConfig, window: float) -> np.ndarray:
    step = math.radians(config.heading_step_deg)
    if window >= math.pi:
        return np.linspace(-math.pi, math.pi, math.ceil(2.0 * math.pi / step), endpoint=False)
    half = math.floor(window / step + 1e-9)
    return step * np.arange(-half, half + 1)


@njit(cache=True)
def _stamp(grid: np.ndarray, points: np.ndarray, resolution: float, deviation: float, reach: int) -> None:
    """Raise the cells around each point to its likelihood at their centres."""
    scale = -0.5 * (resolution / deviation) ** 2
    across = np.empty(2 * reach + 1)
    for k in range(len(points)):
        x, y = points[k, 0] / resolution, points[k, 1] / resolution
        column, row = math.floor(x) - reach, math.floor(y) - reach
        for j in range(2 * reach + 1):
            across[j] = math.exp(scale * (column + j + 0.5 - x) ** 2)
        for i in range(2 * reach + 1):
            up = 255.0 * math.exp(scale * (row + i + 0.5 - y) ** 2)
            for j in range(2 * reach + 1):
                value = np.uint8(round(up * across[j]))
                grid[row + i, column + j] = max(grid[row + i, column + j], value)


def _blocks_near(offsets: np.ndarray, reach: float, step: int, columns: int, rows: int) -> np.ndarray:
    """Which blocks of a lattice have a cell within a reach of one of the offsets ``(k, 2)`` from its corner, bool."""
    shape = np.array((-(-columns // step), -(-rows // step)))
    around = math.ceil(reach / step) + 1
    i, j = np.mgrid[-around : around + 1, -around : around + 1]
    block = np.unique(np.floor(offsets / step).astype(np.int64), axis=0)
    blocks = (block[:, None] + np.stack((i.ravel(), j.ravel()), axis=1)).reshape(-1, 2)
    blocks = np.unique(blocks[((blocks >= 0) & (blocks < shape)).all(axis=1)], axis=0)
    away = KDTree(offsets).query((blocks + 0.5) * step)[0]
    blocks = blocks[away <= reach + step * math.sqrt(0.5)]
    begin = np.zeros(shape, np.bool_)
    begin[tuple(blocks.T)] = True
    return begin


@njit(cache=True)
def _bound(level: np.ndarray, cells: np.ndarray, across: int, up: int, least: float) -> int:
    """Sum of the likelihoods at cells ``(n, 2)`` moved by ``across`` columns and ``up`` rows; -1 below ``least``."""
    rows, columns = level.shape
    # Negative numbers are large ones without a sign: one comparison tells both borders.
    high, wide = np.uint32(rows), np.uint32(columns)
    total, lowest = 0, least - 255.0 * len(cells)  # what the points so far must reach where all others are sure
    for k in range(len(cells)):
        column, row = np.uint32(cells[k, 0] + across), np.uint32(cells[k, 1] + up)
        if column < wide and row < high:
            total += level[row, column]
        lowest += 255.0
        if total < lowest:
            return -1
    return total


@njit(cache=True)
def _best_first(
    levels: np.ndarray, cells: np.ndarray, headings: np.ndarray, half_x: int, half_y: int, begin: np.ndarray,
    apart: float, apart_rad: float, least_response: float, least_second: float, most_blocks: int,
) -> tuple[float, float, tuple[int, int, int], tuple[int, int, int]]:  # fmt: skip
    """Response, second response, and heading, column and row of both; -1 for what was not found."""
    nowhere = (-1, 0, 0)
    depth = len(levels) - 1
    full = 255.0 * cells.shape[1]
    step = 1 << depth
    least = least_response * full
    # A heap of the smallest: sums are negated. Heading, column, row and level make the order of equals definite.
    heap = [(0, 0, 0, 0, 0) for _ in range(0)]
    for angle in range(len(headings)):
        for i in range(begin.shape[0]):
            for j in range(begin.shape[1]):
                if begin[i, j]:
                    across, up = i * step - half_x, j * step - half_y
                    bound = _bound(levels[depth], cells[angle], across, up, least)
                    if bound >= 0:
                        heap.append((-bound, depth, angle, across, up))
    heapq.heapify(heap)
    best, best_angle, best_across, best_up = -1.0, 0, 0, 0
    blocks = 0
    while len(heap) > 0:
        negative, level, angle, across, up = heapq.heappop(heap)
        if -negative < least:
            break
        found = best >= 0.0
        # The farthest corner of the block: nearer than that, all of it belongs to the best peak.
        last = (1 << level) - 1
        if found:
            far_x = max(abs(across - best_across), abs(min(across + last, half_x) - best_across))
            far_y = max(abs(up - best_up), abs(min(up + last, half_y) - best_up))
            turn = abs(headings[angle] - headings[best_angle])
            turn = min(turn, 2.0 * math.pi - turn)
            if far_x * far_x + far_y * far_y <= apart * apart and turn <= apart_rad:
                continue
        if level == 0:
            if found:
                return best / full, -negative / full, (best_angle, best_across, best_up), (angle, across, up)
            best, best_angle, best_across, best_up = -float(negative), angle, across, up
            least = max(least, least_second * best)
            continue
        blocks += 1
        if blocks > most_blocks:
            return best / full if found else -1.0, -negative / full, (best_angle, best_across, best_up), nowhere
        size = 1 << (level - 1)
        for i in range(2):
            for j in range(2):
                column, row = across + i * size, up + j * size
                if column <= half_x and row <= half_y:
                    bound = _bound(levels[level - 1], cells[angle], column, row, least)
                    if bound >= 0:
                        heapq.heappush(heap, (-bound, level - 1, angle, column, row))
    if best < 0.0:
        return -1.0, 0.0, nowhere, nowhere
    return best / full, least / full, (best_angle, best_across, best_up), nowhere
