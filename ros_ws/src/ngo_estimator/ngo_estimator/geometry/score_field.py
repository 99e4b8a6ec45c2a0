"""How well points fit what scans have seen: 1 at walls, 0 where rays passed, between them where nothing is known.

A return where many other scans saw through is no wall: something moves there. Maxima over blocks of cells bound the
score of many poses at once (Hess et al. 2016, section V).
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.planar_motion import Array

Counts = NDArray[np.int16]
Field = NDArray[np.uint8]
Cells = NDArray[np.int32]

_DEPTH = 3
"""Blocks have up to ``2 ** _DEPTH`` cells a side."""

_MARGIN = 2 << _DEPTH
"""Cells of the field round all that was seen: blocks that begin there may reach into it."""

_LONGEST_GAP_M = 1.5
"""Neighbouring points farther apart are not joined."""


@dataclass(frozen=True)
class ScoreFieldConfig:
    """Cells of ``cell_m``, up to ``reach_m`` from the middle. Points ``deviation_m`` from a wall score 0.61. What was
    never seen scores ``unknown``. A return is no wall where over ``passed`` times as many scans saw through its cell as
    saw a return in it."""

    cell_m: float = 0.06
    reach_m: float = 30.0
    deviation_m: float = 0.10
    unknown: float = 0.6
    passed: float = 1.5

    @property
    def side(self) -> int:
        """Cells on a side of the field."""
        return 2 * math.ceil(self.reach_m / self.cell_m)


class RayCounts:
    """In how many scans rays ended in and passed each cell round ``middle`` ``(2,)``; the oldest can be forgotten."""

    def __init__(self, config: ScoreFieldConfig, middle: Array) -> None:
        self.config = config
        self.hits = np.zeros((config.side, config.side), np.int16)
        self.passes = np.zeros((config.side, config.side), np.int16)
        # Of each: cells in which rays ended, and that they passed; the origin and the ends.
        self._scans: deque[tuple[Cells, Cells, Array, Array]] = deque()
        self._marks, self._mark = np.zeros((config.side, config.side), np.int32), 0
        self._kernel = _kernel(config)
        self.begin_at(middle)

    def begin_at(self, middle: Array) -> None:
        """Forget all scans; the cells lie round another ``middle``."""
        while self._scans:
            self.forget_oldest()
        self.middle, self.corner = middle, middle - 0.5 * self.config.side * self.config.cell_m
        # Row and column of what was seen.
        self._low, self._high = np.full(2, self.config.side, np.int64), np.zeros(2, np.int64)

    def move_to(self, middle: Array) -> None:
        """Count the same scans round another ``middle``."""
        scans = list(self._scans)
        self.begin_at(middle)
        for *_, origin, ends in scans:
            self.add(origin, ends)

    def add(self, origin: Array, ends: Array) -> None:
        """Count a scan's rays from ``origin`` ``(2,)`` to their ``ends`` ``(n, 2)``."""
        self._mark += 2
        begin, stops = origin - self.corner, ends - self.corner
        _widen(self._low, self._high, begin, stops, self.config.cell_m, self.config.side)
        cells = _seen(self._marks, begin, stops, self.config.cell_m, self._mark)
        self._scans.append((*cells, origin, ends))
        _count(self.hits, self.passes, *cells, 1)

    def forget_oldest(self) -> None:
        """Take back the oldest scan."""
        _count(self.hits, self.passes, *self._scans.popleft()[:2], -1)

    def walls(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points ``(n, 2)`` are on walls: not more rays passed there than the settings say."""
        result: NDArray[np.bool_] = _walls(
            self.hits, self.passes, points - self.corner, self.config.cell_m, self.config.passed
        )
        return result

    def field(self, points: Array) -> "ScoreField":
        """The field with walls at points ``(n, 2)``."""
        config = self.config
        # What lies outside of all that was seen is unknown, as the field says of what is outside of it.
        (top, left), (bottom, right) = self._low, self._high
        levels = np.empty((_DEPTH + 1, bottom - top, right - left), np.uint8)
        corner = self.corner + config.cell_m * np.array((left, top))
        np.multiply(self.passes[top:bottom, left:right] <= 0, np.uint8(round(255 * config.unknown)), out=levels[0])
        _draw(levels[0], points - corner, config.cell_m, self._kernel)
        for h in range(_DEPTH):
            _pool(levels[h], levels[h + 1], 1 << h)
        return ScoreField(levels, corner, config)


@dataclass(frozen=True, eq=False)
class ScoreField:
    """Scores ``(depth + 1, rows, columns)`` of 0 to 255; cell ``(row, column)`` of level ``h`` has the largest of the
    ``2 ** h`` cells from there on in x (columns) and y (rows). The cell [0, 0] begins at ``corner`` ``(2,)``."""

    levels: Field
    corner: Array
    config: ScoreFieldConfig

    def score(self, points: Array, pose: Array) -> float:
        """Mean score (0 to 1) of points ``(n, 2)`` whose frame has the pose ``(3,)``; unknown without a point."""
        if not len(points):
            return self.config.unknown
        unknown = round(255 * self.config.unknown)
        return float(_score(self.levels[0], points, pose, self.corner, self.config.cell_m, unknown))

    def scores(self, points: Array, poses: Array, unknown: float) -> Array:
        """Mean scores ``(m,)`` of at least one point ``(n, 2)`` at each of the poses ``(m, 3)``, where what was never
        seen scores ``unknown``."""
        code = round(255 * self.config.unknown)
        result: Array = _scores(self.levels[0], points, poses, self.corner, self.config.cell_m, code, unknown)
        return result


def _kernel(config: ScoreFieldConfig) -> Field:
    reach = math.ceil(2.5 * config.deviation_m / config.cell_m)
    squares = (np.arange(-reach, reach + 1) * config.cell_m / config.deviation_m) ** 2
    result: Field = np.round(255.0 * np.exp(-0.5 * (squares[:, None] + squares))).astype(np.uint8)
    return result


@njit(cache=True)
def _widen(low: NDArray[np.int64], high: NDArray[np.int64], origin: Array, ends: Array, cell: float, side: int) -> None:
    """Widen the rows and columns of what was seen by the ends of a scan's rays, with a margin."""
    for axis in range(2):
        least = most = origin[axis]
        for k in range(len(ends)):
            least, most = min(least, ends[k, axis]), max(most, ends[k, axis])
        low[1 - axis] = min(low[1 - axis], max(math.floor(least / cell) - _MARGIN, 0))
        high[1 - axis] = max(high[1 - axis], min(math.floor(most / cell) + _MARGIN + 1, side))


@njit(cache=True)
def _seen(marks: NDArray[np.int32], origin: Array, ends: Array, cell: float, mark: int) -> tuple[Cells, Cells]:
    """Cells in which rays of a scan ended, and those that they passed and none ended in, each once.

    Cells get ``mark`` or one more.
    """
    rows, columns = marks.shape
    marked = marks.ravel()
    ended, passed = np.empty(len(ends), np.int32), np.empty(4096, np.int32)
    count = 0
    for k in range(len(ends)):
        row, column = math.floor(ends[k, 1] / cell), math.floor(ends[k, 0] / cell)
        if 0 <= row < rows and 0 <= column < columns and marked[row * columns + column] != mark:
            ended[count] = row * columns + column
            marked[ended[count]] = mark
            count += 1
    free = 0
    begin_x, begin_y = origin[0] / cell, origin[1] / cell
    for k in range(len(ends)):
        x, y = ends[k, 0] - origin[0], ends[k, 1] - origin[1]
        length = math.hypot(x, y)
        steps = int(length / cell - 1.5)
        while free + steps > len(passed):
            passed = np.concatenate((passed, np.empty_like(passed)))
        step_x, step_y = x / length if steps > 0 else 0.0, y / length if steps > 0 else 0.0
        for s in range(steps):
            row, column = int(begin_y + s * step_y), int(begin_x + s * step_x)
            if not (0 <= row < rows and 0 <= column < columns):
                break
            at = row * columns + column
            if marked[at] < mark:
                marked[at] = mark + 1
                passed[free] = at
                free += 1
    return ended[:count].copy(), passed[:free].copy()


@njit(cache=True)
def _count(hits: Counts, passes: Counts, ended: Cells, passed: Cells, times: int) -> None:
    hit, through = hits.ravel(), passes.ravel()
    for k in range(len(ended)):
        hit[ended[k]] += times
    for k in range(len(passed)):
        through[passed[k]] += times


@njit(cache=True)
def _walls(hits: Counts, passes: Counts, points: Array, cell: float, ratio: float) -> NDArray[np.bool_]:
    rows, columns = hits.shape
    result = np.ones(len(points), np.bool_)
    for k in range(len(points)):
        row, column = math.floor(points[k, 1] / cell), math.floor(points[k, 0] / cell)
        if not (1 <= row < rows - 1 and 1 <= column < columns - 1):
            continue
        if passes[row, column] == 0:
            continue
        ended = 0
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                ended = max(ended, hits[r, c])
        result[k] = passes[row, column] <= ratio * ended
    return result


@njit(cache=True)
def _draw(field: Field, points: Array, cell: float, kernel: Field) -> None:
    rows, columns = field.shape
    reach = len(kernel) // 2
    for k in range(len(points)):
        row, column = math.floor(points[k, 1] / cell), math.floor(points[k, 0] / cell)
        if not (reach <= row < rows - reach and reach <= column < columns - reach) or field[row, column] == 255:
            continue
        for i in range(len(kernel)):
            drawn, values = field[row + i - reach, column - reach : column + reach + 1], kernel[i]
            for j in range(len(values)):
                drawn[j] = max(drawn[j], values[j])


@njit(cache=True)
def _pool(fine: Field, coarse: Field, step: int) -> None:
    """The largest of four cells ``step`` apart; at the far edges, which no robot reaches, those that there are."""
    rows, columns = fine.shape
    for row in range(rows):
        other = min(row + step, rows - 1)
        for c in range(columns - step):
            coarse[row, c] = max(fine[row, c], fine[row, c + step], fine[other, c], fine[other, c + step])
        for c in range(columns - step, columns):
            coarse[row, c] = max(fine[row, c], fine[other, c])


@njit(cache=True)
def _seen_at(field: Field, points: Array, pose: Array, corner: Array, cell: float, unknown: int) -> tuple[int, int]:
    """Sum of the cells at points ``(n, 2)`` whose frame has the pose ``(3,)``, and how many were never seen."""
    rows, columns = field.shape
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    total, unseen = 0, 0
    for k in range(len(points)):
        x = cos * points[k, 0] - sin * points[k, 1] + pose[0] - corner[0]
        y = sin * points[k, 0] + cos * points[k, 1] + pose[1] - corner[1]
        row, column = math.floor(y / cell), math.floor(x / cell)
        value = field[row, column] if 0 <= row < rows and 0 <= column < columns else unknown
        if value == unknown:
            unseen += 1
        else:
            total += value
    return total, unseen


@njit(cache=True)
def _score(field: Field, points: Array, pose: Array, corner: Array, cell: float, unknown: int) -> float:
    total, unseen = _seen_at(field, points, pose, corner, cell, unknown)
    return (total + unseen * unknown) / (255.0 * len(points))


@njit(cache=True)
def _scores(
    field: Field, points: Array, poses: Array, corner: Array, cell: float, code: int, unknown: float
) -> Array:  # fmt: skip
    result = np.empty(len(poses))
    for i in range(len(poses)):
        total, unseen = _seen_at(field, points, poses[i], corner, cell, code)
        result[i] = (total / 255.0 + unseen * unknown) / len(points)
    return result


@njit(cache=True)
def joined(points: Array, normals: Array, spacing: float) -> Array:
    """The points ``(n, 2)``, and more between neighbours whose surfaces face alike and whose gap runs along these."""
    between = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points) - 1):
        x, y = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
        length = math.hypot(x, y)
        alike = normals[i, 0] * normals[i + 1, 0] + normals[i, 1] * normals[i + 1, 1] > 0.95
        if alike and length < _LONGEST_GAP_M and abs(x * normals[i, 0] + y * normals[i, 1]) < 0.2 * length:
            between[i] = int(length / spacing)
    result = np.empty((len(points) + between.sum(), 2))
    place = 0
    for i in range(len(points)):
        for j in range(between[i] + 1):
            share = j / (between[i] + 1)
            for axis in range(2):
                step = points[i + 1, axis] - points[i, axis] if between[i] else 0.0
                result[place, axis] = points[i, axis] + share * step
            place += 1
    return result
