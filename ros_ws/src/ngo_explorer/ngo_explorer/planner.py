"""Paths that keep off obstacles: costs over blocks of cells for choosing, and fine paths for driving."""

from __future__ import annotations

import heapq
import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_explorer.known_map import FREE, Cells, Floats, KnownMap

Wide = NDArray[np.bool_]

_BUCKETS = 64  # above the dearest step between two blocks
_TIGHT = 20  # tenths that a step costs more where the clearance is the least, and at most
_ESCAPE_M = 0.8  # a robot that stands too near an obstacle may start from a block as far as this


def cost_field(known: KnownMap, start_xy: Floats, need_m: float) -> NDArray[np.int32]:
    """Costs ``(rows / block, columns / block)`` of paths from a point to all blocks; -1 where there is none.

    In tenths of a block's side; a step costs up to three times its length where walls are near. By Dijkstra's
    algorithm with buckets (Dial 1969).
    """
    starts = _start_blocks(known, start_xy, need_m)
    return np.asarray(_costs(_wide(known, need_m), known.block, known.roomy_m, need_m, known.comfort_m, starts))


def plan_path(
    known: KnownMap, field: NDArray[np.int32], start_xy: Floats, goal_xy: Floats, need_m: float
) -> Floats | None:
    """Points ``(n, 2)`` a cell apart from the robot to a goal, within the blocks of the cheapest path; or None.

    field: the costs from the robot.
    """
    start, goal = known.cell(start_xy), known.cell(goal_xy)
    last_row, last_column = goal[0] // known.block, goal[1] // known.block
    rows, columns = field.shape
    if not (0 <= last_row < rows and 0 <= last_column < columns) or field[last_row, last_column] < 0:
        return None
    corridor = _corridor(_wide(known, need_m), known.block, field, last_row, last_column)
    row, column = start[0] // known.block, start[1] // known.block
    reach = math.ceil(_ESCAPE_M / (known.block * known.resolution_m))
    corridor[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1] = True
    cells = _fine(
        known.state,
        known.clearance_m,
        corridor,
        known.block,
        need_m,
        known.comfort_m,
        known.resolution_m,
        start[0],
        start[1],
        goal[0],
        goal[1],
    )
    return known.points(cells) if len(cells) else None


def line_is_free(known: KnownMap, begin_xy: Floats, end_xy: Floats, need_m: float) -> bool:
    """Whether the robot may drive straight from one point to another."""
    (x0, y0), (x1, y1) = ((point[:2] - known.corner_xy) / known.resolution_m for point in (begin_xy, end_xy))
    return bool(_line(known.state, known.clearance_m, x0, y0, x1, y1, need_m))


def _start_blocks(known: KnownMap, start_xy: Floats, need_m: float) -> NDArray[np.int64]:
    """Blocks ``(n, 2)`` that the robot can be in, up to need_m away, or else a nearest one; none: there is none.

    To within a block, no wall lies between the robot and those up to need_m away: it would be nearer to them than
    need_m. All of them count, since the one that the robot is in may be cut off by a cell.
    """
    row, column = (value // known.block for value in known.cell(start_xy))
    side_m = known.block * known.resolution_m
    reach = math.ceil(_ESCAPE_M / side_m)
    low_row, low_column = max(0, row - reach), max(0, column - reach)
    near = known.roomy_m[low_row : max(0, row + reach + 1), low_column : max(0, column + reach + 1)]
    found = np.argwhere(near >= need_m) + (low_row, low_column)
    away_m = side_m * np.hypot(*(found - (row, column)).T)
    within = found[away_m <= need_m]
    return within if len(within) or not len(found) else found[[np.argmin(away_m)]]


def _wide(known: KnownMap, need_m: float) -> Wide:
    return np.asarray((known.state == FREE) & (known.clearance_m >= need_m))


@njit(cache=True)
def _leads(wide: Wide, block: int, row: int, column: int, r: int, c: int) -> bool:
    """Whether a way over ``wide`` cells leads from a block into a neighbour; diagonally past the corner or round it.

    That both have such cells is not enough: these may lie on both sides of a gap that is too narrow.
    """
    if row == r or column == c:
        return _passes(wide, block, row, column, r, c)
    y, x = max(row, r) * block, max(column, c) * block
    below, left = (1, 0) if r > row else (0, 1), (1, 0) if c > column else (0, 1)
    if wide[y - below[0], x - left[0]] and wide[y - below[1], x - left[1]]:
        return True
    by_row = _passes(wide, block, row, column, r, column) and _passes(wide, block, r, column, r, c)
    return by_row or (_passes(wide, block, row, column, row, c) and _passes(wide, block, row, c, r, c))


@njit(cache=True)
def _passes(wide: Wide, block: int, row: int, column: int, r: int, c: int) -> bool:
    """Whether two wide cells touch across the side between two blocks."""
    y, x = max(row, r) * block, max(column, c) * block
    for first in range(block):
        for second in range(max(0, first - 1), min(block, first + 2)):
            if row == r and wide[y + first, x - 1] and wide[y + second, x]:
                return True
            if column == c and wide[y - 1, x + first] and wide[y, x + second]:
                return True
    return False


@njit(cache=True)
def _costs(
    wide: Wide,
    block: int,
    roomy: NDArray[np.float32],
    need: float,
    comfort: float,
    starts: NDArray[np.int64],
) -> NDArray[np.int32]:
    rows, columns = roomy.shape
    costs = np.full((rows, columns), -1, np.int32)
    done = np.zeros((rows, columns), np.bool_)
    heads = np.full(_BUCKETS, -1, np.int64)
    entries = np.empty(1024 + len(starts), np.int64)
    following = np.empty(1024 + len(starts), np.int64)
    used, waiting = len(starts), len(starts)
    for index in range(len(starts)):
        row, column = starts[index]
        entries[index], following[index] = row * columns + column, index - 1
        costs[row, column] = 0
    heads[0] = len(starts) - 1
    now = 0
    while waiting > 0:
        entry = heads[now % _BUCKETS]
        if entry < 0:
            now += 1
            continue
        heads[now % _BUCKETS] = following[entry]
        waiting -= 1
        row, column = entries[entry] // columns, entries[entry] % columns
        if done[row, column]:
            continue
        done[row, column] = True
        for d_row in range(-1, 2):
            for d_column in range(-1, 2):
                r, c = row + d_row, column + d_column
                if r < 0 or c < 0 or r >= rows or c >= columns or done[r, c] or roomy[r, c] < need:
                    continue
                tight = 1.0 - min(1.0, (roomy[r, c] - need) / max(comfort - need, 1e-6))
                step = (14 if d_row != 0 and d_column != 0 else 10) * (10 + int(_TIGHT * tight)) // 10
                cost = now + step
                if (costs[r, c] >= 0 and costs[r, c] <= cost) or not _leads(wide, block, row, column, r, c):
                    continue
                costs[r, c] = cost
                if used == len(entries):
                    more, links = np.empty(2 * used, np.int64), np.empty(2 * used, np.int64)
                    more[:used], links[:used] = entries, following
                    entries, following = more, links
                entries[used], following[used] = r * columns + c, heads[cost % _BUCKETS]
                heads[cost % _BUCKETS] = used
                used += 1
                waiting += 1
    return costs


@njit(cache=True)
def _corridor(wide: Wide, block: int, field: NDArray[np.int32], row: int, column: int) -> Wide:
    """The blocks of the cheapest path to a block and those beside them."""
    rows, columns = field.shape
    marked = np.zeros((rows, columns), np.bool_)
    while True:
        for r in range(max(0, row - 2), min(rows, row + 3)):
            for c in range(max(0, column - 2), min(columns, column + 3)):
                marked[r, c] = True
        if field[row, column] == 0:
            return marked
        best, next_row, next_column = field[row, column], row, column
        for r in range(max(0, row - 1), min(rows, row + 2)):
            for c in range(max(0, column - 1), min(columns, column + 2)):
                if 0 <= field[r, c] < best and _leads(wide, block, row, column, r, c):
                    best, next_row, next_column = field[r, c], r, c
        if next_row == row and next_column == column:
            return marked
        row, column = next_row, next_column


@njit(cache=True)
def _fine(
    state: Cells,
    clearance: NDArray[np.float32],
    corridor: NDArray[np.bool_],
    block: int,
    need: float,
    comfort: float,
    resolution: float,
    row0: int,
    column0: int,
    goal_row: int,
    goal_column: int,
) -> NDArray[np.int64]:
    """Cells of the cheapest path (A*), none without one. Around the start only occupied cells are barred."""
    low_row, high_row, low_column, high_column = corridor.shape[0], -1, corridor.shape[1], -1
    for row in range(corridor.shape[0]):
        for column in range(corridor.shape[1]):
            if corridor[row, column]:
                low_row, high_row = min(low_row, row), max(high_row, row)
                low_column, high_column = min(low_column, column), max(high_column, column)
    top, left = low_row * block, low_column * block
    rows = min((high_row + 1) * block, state.shape[0]) - top
    columns = min((high_column + 1) * block, state.shape[1]) - left
    costs = np.full(rows * columns, np.inf, np.float32)
    parents = np.full(rows * columns, -1, np.int64)
    first = (row0 - top) * columns + column0 - left
    last = (goal_row - top) * columns + goal_column - left
    inside = 0 <= row0 - top < rows and 0 <= column0 - left < columns
    inside = inside and 0 <= goal_row - top < rows and 0 <= goal_column - left < columns
    if not inside:
        return np.zeros((0, 2), np.int64)
    costs[first] = 0.0
    queue = [(0.0, first)]
    done = np.zeros(rows * columns, np.bool_)
    while len(queue) > 0:
        _, cell = heapq.heappop(queue)
        if cell == last:
            break
        if done[cell]:
            continue
        done[cell] = True
        row, column = cell // columns, cell % columns
        for d_row in range(-1, 2):
            for d_column in range(-1, 2):
                r, c = row + d_row, column + d_column
                if r < 0 or c < 0 or r >= rows or c >= columns or done[r * columns + c]:
                    continue
                there_row, there_column = r + top, c + left
                if not corridor[there_row // block, there_column // block]:
                    continue
                free, gap = state[there_row, there_column] == 0, clearance[there_row, there_column]
                from_start = resolution * math.hypot(there_row - row0, there_column - column0)
                if (not free or gap < need) and (state[there_row, there_column] == 1 or from_start > need):
                    continue
                tight = 1.0 - min(1.0, max(0.0, gap - need) / max(comfort - need, 1e-6))
                step = math.hypot(d_row, d_column) * (1.0 + _TIGHT / 10.0 * tight)
                after = r * columns + c
                if costs[cell] + step < costs[after]:
                    costs[after] = costs[cell] + step
                    parents[after] = cell
                    ahead = math.hypot(there_row - goal_row, there_column - goal_column)
                    heapq.heappush(queue, (costs[after] + ahead, after))
    if not np.isfinite(costs[last]):
        return np.zeros((0, 2), np.int64)
    count, cell = 0, last
    while cell >= 0:
        count += 1
        cell = parents[cell]
    way = np.empty((count, 2), np.int64)
    cell = last
    for index in range(count):
        way[count - 1 - index] = cell // columns + top, cell % columns + left
        cell = parents[cell]
    return way


@njit(cache=True)
def _line(
    state: Cells, clearance: NDArray[np.float32], x0: float, y0: float, x1: float, y1: float, need: float
) -> bool:
    steps = int(2.0 * math.hypot(x1 - x0, y1 - y0)) + 1
    for step in range(1, steps + 1):
        share = step / steps
        row, column = math.floor(y0 + share * (y1 - y0)), math.floor(x0 + share * (x1 - x0))
        if not (0 <= row < state.shape[0] and 0 <= column < state.shape[1]):
            return False
        if state[row, column] != 0 or clearance[row, column] < need:
            return False
    return True
