"""An occupancy grid that scans can be taken out of again: it counts, and the counts of a scan are those of its pose.

Log odds of occupancy grids (Moravec and Elfes 1985) are sums over scans. Here the sums are kept as integers a cell,
so that a scan which moves is subtracted where it was, to the last bit, and added where it is.

What was seen in the newest epoch in which a cell was seen is counted apart: what older epochs say is bounded, so that
the newest one can change it, as by the clamping of OctoMap (Hornung et al. 2013).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.mapping.range_scan import Array, RangeScan

UNKNOWN = -1
"""Value of a cell that nothing is known of."""

_CHUNK = 64  # cells by which the grid grows
_MOST_CELLS = 40_000_000
_MOST_GRAZED = 24.0  # cells at the end of a ray that are not called free, however flat it meets a wall
_NOTHING = (_MOST_CELLS, _MOST_CELLS, 0, 0)
"""Low row and column, and the high ones beyond them, of no cell."""
Counts = NDArray[np.int32]
Epochs = NDArray[np.int64]

_HITS, _PASSES, _EPOCH, _NEW_HITS, _NEW_PASSES, _MARK = range(6)
"""Of each cell: counts of all scans, the newest epoch in which it was seen, counts of that one, and the last scan."""


@dataclass(frozen=True)
class OccupancyConfig:
    """How counts become probabilities.

    A scan that ends in a cell adds ``hit`` to the cell's log odds, one that looks through it subtracts ``passed``. A
    cell is occupied from the probability ``occupied`` on, and free up to ``free``; the rest is unknown. What older
    epochs say counts up to the log odds ``settled``.
    """

    hit: float = 2.2
    passed: float = 0.7
    settled: float = 3.5
    occupied: float = 0.65
    free: float = 0.25

    def __post_init__(self) -> None:
        check_positive(self, "hit passed")
        check(self, "settled", "positive", lambda x: x > 0.0)
        if not 0.0 <= self.free < self.occupied <= 1.0:
            raise ValueError(f"free, occupied are {self.free}, {self.occupied}; expected 0 <= free < occupied <= 1")


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Values ``(rows, columns)`` of a map's cells.

    Row 0 is the lowest in y, column 0 the lowest in x, and ``origin_xy`` ``(2,)`` the lower left corner of cell [0, 0]
    (m). Values are percent, or -1 where nothing is known. Outside of the rows and columns ``changed`` they are those of
    the map that the same grid gave before; None: its extent was another, or nobody knows.
    """

    values: NDArray[np.int8]
    resolution_m: float
    origin_xy: Array
    changed: tuple[slice, slice] | None = None

    def trinary(self, free: float, occupied: float) -> "OccupancyMap":
        """The same map with the values 0 up to the probability ``free``, 100 from ``occupied`` on, else -1."""
        percent = np.arange(256, dtype=np.uint8).view(np.int8)
        sure = [percent < 0, percent <= 100.0 * free, percent >= 100.0 * occupied]
        of_percent = np.select(sure, [UNKNOWN, 0, 100], UNKNOWN).astype(np.int8)
        return OccupancyMap(of_percent[self.values.view(np.uint8)], self.resolution_m, self.origin_xy)

    def cropped(self) -> "OccupancyMap":
        """The part that anything is known of."""
        known = self.values != UNKNOWN
        rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return OccupancyMap(np.zeros((0, 0), np.int8), self.resolution_m, self.origin_xy)
        return self.part(slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))

    def part(self, rows: slice, columns: slice) -> "OccupancyMap":
        """The part of some rows and columns."""
        corner = self.origin_xy + self.resolution_m * np.array((columns.start, rows.start))
        return OccupancyMap(self.values[rows, columns], self.resolution_m, corner)


class MapTooLarge(ValueError):
    """Scans lie so far apart that no map of them fits into memory; the map is as it was before.

    With cells ``coarser`` times as large, a power of 2, it would fit.
    """

    def __init__(self, message: str, coarser: float = math.inf) -> None:
        super().__init__(message)
        self.coarser = coarser


class OccupancyGrid:
    """Counts, in each cell, the scans that ended there and those that looked through it.

    A scan counts once in a cell. Where one of its rays ends, its other rays do not count. The grid grows with what is
    entered.
    """

    def __init__(self, resolution_m: float) -> None:
        if not 0.0 < resolution_m < math.inf:
            raise ValueError(f"resolution_m is {resolution_m}; expected a positive length")
        self.resolution_m = resolution_m
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._low = np.zeros(2, np.int64)  # column and row, counted from the cell round the frame's origin
        self._cells = np.zeros((0, 0, 6), np.int32)
        self._mark = 0
        self._values, self._of = np.zeros((0, 0), np.int8), OccupancyConfig()
        self._stale = _NOTHING

    def add(self, scans: Sequence[RangeScan], poses: Array, epochs: Epochs | None = None) -> None:
        """Enter scans of ``epochs`` ``(scans,)``, from 0 on, at poses ``(scans, 3)`` of their base.

        Raises ``MapTooLarge``.
        """
        self._render(scans, poses, epochs, 1)

    def remove(self, scans: Sequence[RangeScan], poses: Array, epochs: Epochs | None = None) -> None:
        """Take scans out that were entered at exactly these poses ``(scans, 3)``, with these ``epochs``."""
        self._render(scans, poses, epochs, -1)

    def cells(self, config: OccupancyConfig) -> OccupancyMap:
        """The probabilities of all cells; the extent grows in large steps, so that it seldom changes.

        Where no scan was entered or removed since the last call they are those of then.
        """
        rows, columns, _ = self._cells.shape
        top, left, low, right = self._stale
        changed: tuple[slice, slice] | None = (slice(top, low), slice(left, right))
        if self._values.shape != (rows, columns) or config != self._of:
            self._values, self._of = np.empty((rows, columns), np.int8), config
            self._stale, changed = (0, 0, rows, columns), None
        _percent(self._cells, self._values, *self._stale, config.hit, config.passed, config.settled)
        self._stale = _NOTHING
        corner = (self._low.astype(np.float64) - 0.5) * self.resolution_m
        return OccupancyMap(self._values.copy(), self.resolution_m, corner, changed)

    @classmethod
    def summed(cls, grids: Sequence["OccupancyGrid"]) -> "OccupancyGrid":
        """The counts of several grids together; raises ``ValueError`` where their cells differ, ``MapTooLarge``."""
        sides = {grid.resolution_m for grid in grids}
        if len(sides) != 1:
            raise ValueError(f"the grids have cells of {sorted(sides)} m; expected one side")
        whole = cls(sides.pop())
        known = [grid for grid in grids if grid._cells.size]
        for grid in known:
            whole._cover(np.stack((grid._low, grid._low + grid._cells.shape[1::-1] - 1)).astype(np.float64))
        for grid in known:
            (column, row), (rows, columns, _) = (grid._low - whole._low).tolist(), grid._cells.shape
            here, its = whole._cells[row : row + rows, column : column + columns], grid._cells
            newest = np.maximum(here[..., _EPOCH], its[..., _EPOCH])
            for old, new in ((_HITS, _NEW_HITS), (_PASSES, _NEW_PASSES)):
                here[..., old] += its[..., old]
                here[..., new] = sum(np.where(of[..., _EPOCH] == newest, of[..., new], 0) for of in (here, its))
            here[..., _EPOCH] = newest
        return whole

    def _render(self, scans: Sequence[RangeScan], poses: Array, epochs: Epochs | None, sign: int) -> None:
        if not len(scans):
            return
        ends = np.concatenate([scan.ends for scan in scans]).astype(np.float64)
        hits = np.concatenate([scan.hits for scan in scans])
        counts = np.array([len(scan.ends) for scan in scans])
        sensors = np.array([scan.sensor_xyyaw[:2] for scan in scans])
        eyes = _in_cells(sensors, np.arange(len(scans)), poses, self.resolution_m)
        ends = _in_cells(ends, np.repeat(np.arange(len(scans)), counts), poses, self.resolution_m)
        points = np.concatenate((eyes, ends))
        self._cover(points)
        low = (np.floor(points.min(axis=0)).astype(int) - self._low)[::-1]
        high = (np.floor(points.max(axis=0)).astype(int) - self._low)[::-1] + 1
        before = self._stale
        self._stale = (*np.minimum(before[:2], low).tolist(), *np.maximum(before[2:], high).tolist())
        if self._mark > np.iinfo(np.int32).max - len(scans):
            self._cells[..., _MARK], self._mark = 0, 0
        starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
        of_scans = np.zeros(len(scans), np.int64) if epochs is None else epochs
        _count(self._cells, self._low[0], self._low[1], eyes, ends, hits, starts, of_scans, self._mark, sign)
        self._mark += len(scans)

    def _cover(self, points: Array) -> None:
        """Let the grid cover points ``(n, 2)`` in cells."""
        low, high = np.floor(points.min(axis=0)), np.floor(points.max(axis=0)) + 1.0
        if self._cells.size:
            rows, columns, _ = self._cells.shape
            low, high = np.minimum(low, self._low), np.maximum(high, self._low + (columns, rows))
        low, high = np.floor(low / _CHUNK) * _CHUNK, np.ceil(high / _CHUNK) * _CHUNK
        width, height = high - low
        if not width * height <= _MOST_CELLS:
            size = f"{width * self.resolution_m:.0f} m x {height * self.resolution_m:.0f} m"
            # Twice as many: the extent grows in chunks of cells.
            excess = 2.0 * width * height / _MOST_CELLS
            coarser = 2.0 ** math.ceil(0.5 * math.log2(excess)) if math.isfinite(excess) else math.inf
            raise MapTooLarge(
                f"the map would be {size}; expected at most {_MOST_CELLS} cells: use a coarser resolution", coarser
            )
        before = self._cells
        if before.shape[:2] == (height, width):
            return
        corner = low.astype(np.int64)
        column, row = (self._low - corner if before.size else np.zeros(2, np.int64)).tolist()
        self._cells = np.zeros((int(height), int(width), 6), np.int32)
        self._cells[row : row + before.shape[0], column : column + before.shape[1]] = before
        self._low = corner


def _in_cells(points: Array, scan_of: NDArray[np.int64], poses: Array, resolution: float) -> Array:
    """Points ``(n, 2)`` of the frames ``poses[scan_of]`` in the map's frame, in cells."""
    x, y, yaw = poses[scan_of].T
    cos, sin = np.cos(yaw), np.sin(yaw)
    moved = np.stack((x + cos * points[:, 0] - sin * points[:, 1], y + sin * points[:, 0] + cos * points[:, 1]), -1)
    # The frame's origin is the middle of a cell. A robot often begins in the middle of a corridor, along a wall: that
    # wall then lies within a row of cells, and not where two rows meet, whose cells would take turns.
    return moved / resolution + 0.5


@njit(cache=True)
def _tell(cell: Counts, of_all: int, of_newest: int, epoch: int, sign: int) -> None:
    """Count a scan of an epoch in a cell ``(6,)``, among all and among those of the newest epoch."""
    cell[of_all] += sign
    if epoch > cell[_EPOCH]:
        cell[_EPOCH], cell[_NEW_HITS], cell[_NEW_PASSES] = epoch, 0, 0
    if epoch == cell[_EPOCH]:
        cell[of_newest] += sign


@njit(cache=True)
def _count(
    cells: Counts,
    low_column: int,
    low_row: int,
    eyes: Array,
    ends: Array,
    is_hit: NDArray[np.bool_],
    starts: NDArray[np.int64],
    of_scans: Epochs,
    mark: int,
    sign: int,
) -> None:
    """Count scans; the rays of scan ``s`` are ``starts[s]`` to ``starts[s + 1]``. Cells are traversed from side to side
    (Amanatides and Woo 1987)."""
    for s in range(len(eyes)):
        mark += 1
        for ray in range(starts[s], starts[s + 1]):
            column, row = math.floor(ends[ray, 0]) - low_column, math.floor(ends[ray, 1]) - low_row
            if is_hit[ray] and cells[row, column, _MARK] != mark:
                cells[row, column, _MARK] = mark
                _tell(cells[row, column], _HITS, _NEW_HITS, of_scans[s], sign)
        for ray in range(starts[s], starts[s + 1]):
            x, y = eyes[s, 0], eyes[s, 1]
            free = _free_share(ends, is_hit, starts[s], starts[s + 1], ray, x, y)
            along_x, along_y = free * (ends[ray, 0] - x), free * (ends[ray, 1] - y)
            column, row = math.floor(x), math.floor(y)
            columns, rows = abs(math.floor(x + along_x) - column), abs(math.floor(y + along_y) - row)
            step_x, step_y = 1 if along_x > 0.0 else -1, 1 if along_y > 0.0 else -1
            per_x = 1.0 / abs(along_x) if along_x != 0.0 else math.inf
            per_y = 1.0 / abs(along_y) if along_y != 0.0 else math.inf
            next_x = (column + 1 - x if step_x > 0 else x - column) * per_x if along_x != 0.0 else math.inf
            next_y = (row + 1 - y if step_y > 0 else y - row) * per_y if along_y != 0.0 else math.inf
            column, row = column - low_column, row - low_row
            # As many sides as lie between both cells: rounding cannot lead past the end.
            while columns + rows > 0:
                if cells[row, column, _MARK] != mark:
                    cells[row, column, _MARK] = mark
                    _tell(cells[row, column], _PASSES, _NEW_PASSES, of_scans[s], sign)
                if rows == 0 or (columns > 0 and next_x < next_y):
                    column, columns, next_x = column + step_x, columns - 1, next_x + per_x
                else:
                    row, rows, next_y = row + step_y, rows - 1, next_y + per_y


@njit(cache=True)
def _free_share(
    ends: Array, is_hit: NDArray[np.bool_], first: int, end: int, ray: int, eye_x: float, eye_y: float
) -> float:
    """Up to which share of it a ray says that cells are free, 0 to 1: not where it grazes the wall that it meets.

    A ray that meets a wall at a small angle runs through several of the wall's cells before it ends in one: it is less
    than a cell away from the wall there. The wall goes on to where the next rays end; of those on both sides the one
    that makes it steeper counts, as the other one may have met something else.
    """
    if not is_hit[ray]:
        return 1.0
    x, y = ends[ray, 0] - eye_x, ends[ray, 1] - eye_y
    length, sine = math.hypot(x, y), 0.0
    for other in (ray - 1, ray + 1):
        if first <= other < end and is_hit[other]:
            wall_x, wall_y = ends[other, 0] - ends[ray, 0], ends[other, 1] - ends[ray, 1]
            cross = abs(x * wall_y - y * wall_x)
            if cross > 0.0:
                sine = max(sine, cross / (length * math.hypot(wall_x, wall_y)))
    if sine == 0.0:
        return 1.0
    grazes = min(max(1.0 / sine - 1.0, 0.0), _MOST_GRAZED)  # cells
    return max(0.0, 1.0 - grazes / length)


@njit(cache=True)
def _percent(
    cells: Counts,
    values: NDArray[np.int8],
    low_row: int,
    low_column: int,
    high_row: int,
    high_column: int,
    hit: float,
    passed: float,
    settled: float,
) -> None:
    """Write the values of the cells from a low row and column on, up to a high one of each."""
    for row in range(low_row, high_row):
        for column in range(low_column, high_column):
            cell = cells[row, column]
            values[row, column] = UNKNOWN
            if cell[_HITS] | cell[_PASSES]:
                odds = cell[_NEW_HITS] * hit - cell[_NEW_PASSES] * passed
                before = (cell[_HITS] - cell[_NEW_HITS]) * hit - (cell[_PASSES] - cell[_NEW_PASSES]) * passed
                odds += min(max(before, -settled), settled)
                values[row, column] = round(100.0 / (1.0 + math.exp(-min(max(odds, -10.0), 10.0))))
