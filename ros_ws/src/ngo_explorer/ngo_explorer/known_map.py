"""The occupancy grid as an explorer keeps it: clearance, frontier cells and blocks, updated where it changed.

All arrays cover whole tiles. What follows from the cells of a tile is computed anew when one of its cells changes, so
an update costs what changed, and one comparison of the cells that may have.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

UNKNOWN, FREE, OCCUPIED = -1, 0, 1

Floats = NDArray[np.float64]
Cells = NDArray[np.int8]

_NEAR_CELLS = 3.0  # an obstacle that is nearer than this in the map is the same
_NEAR, _NEAR_WALLS = 1, 2  # of a tile: a cell in or beside it changes, and one that is occupied or was
_TILE = 64  # cells along the side of a tile, at least


class KnownMap:
    """What is known of a place.

    ``state`` int8 ``(rows, columns)`` is UNKNOWN, FREE or OCCUPIED; row 0 is the lowest in y. ``clearance_m`` float32
    is the distance to the nearest occupied cell, at most ``comfort_m``, in tiles that something is known of.
    ``frontier`` bool are free cells beside unknown ones. ``roomy_m`` float32 ``(rows / block, columns / block)`` is the
    largest clearance of a free cell in each block, 0 without one. A block is no longer than the robot's radius, so none
    joins two sides of a wall.

    Raises ValueError where the resolution changes.
    """

    def __init__(self, radius_m: float, comfort_m: float) -> None:
        if not 0.0 < radius_m < math.inf:
            raise ValueError(f"radius_m is {radius_m}; expected a positive length")
        self.radius_m, self.comfort_m = radius_m, max(comfort_m, radius_m)
        self.resolution_m = 0.0
        self._marked = np.zeros((0, 2))
        self._extent: tuple[int, ...] = ()  # of the last map, where the cells are still what it said
        self.changes = 0
        """Counts the updates that changed anything."""

    @property
    def empty(self) -> bool:
        """Whether no map has come yet."""
        return self.resolution_m == 0.0

    def update(
        self,
        values: NDArray[np.int8],
        resolution_m: float,
        origin_xy: Floats,
        changed: tuple[slice, slice] | None = None,
    ) -> bool:
        """Take a whole map; returns whether a cell changed.

        values: ``(rows, columns)`` percent, -1 where nothing is known. Cells up to 25 are free, from 65 on occupied,
        and the rest unknown. origin_xy: ``(2,)`` lower left corner of cell [0, 0]. Extent and origin may be others than
        before; cells that the map does not hold become unknown. changed: rows and columns outside of which the values
        are those of the last map; None: all may be others.
        """
        self._begin(resolution_m, origin_xy)
        row, column = self._offset(origin_xy)
        self._cover(row, column, *values.shape)
        extent, self._extent = self._extent, (row, column, *values.shape)
        row, column = row - self._low[0], column - self._low[1]
        if changed is not None and extent == self._extent:
            return self._take(values[changed].copy(), row + changed[0].start, column + changed[1].start)
        placed = np.full(self.state.shape, UNKNOWN, np.int8)
        placed[row : row + values.shape[0], column : column + values.shape[1]] = values
        return self._take(placed)

    def mark(self, points_xy: Floats) -> None:
        """Take points ``(n, 2)`` that the map has nothing near for occupied, whatever it says of them later."""
        rows, columns = self.cells(points_xy).T
        inside = (rows >= 0) & (rows < self.state.shape[0]) & (columns >= 0) & (columns < self.state.shape[1])
        points_xy, rows, columns = points_xy[inside], rows[inside], columns[inside]
        # Clearance is known up to comfort_m only.
        new = points_xy[self.clearance_m[rows, columns] >= min(_NEAR_CELLS * self.resolution_m, self.comfort_m)]
        if len(new):
            self._marked = np.vstack((self._marked, new))
            self._take(self._values())

    def forget_marks(self) -> bool:
        """Take what was marked for free, until the next update says more. Returns whether there was anything."""
        if not len(self._marked):
            return False
        values = self._values()
        values[tuple(self.cells(self._marked).T)] = FREE
        self._marked, self._extent = np.zeros((0, 2)), ()
        self._take(values)
        return True

    def _values(self) -> NDArray[np.int8]:
        return np.where(self.state == OCCUPIED, 100, self.state).astype(np.int8)

    def points(self, cells: NDArray[np.int64]) -> Floats:
        """``(n, 2)`` the middles x, y of cells ``(n, 2)`` row, column."""
        return self._corner + (cells[:, ::-1] + 0.5) * self.resolution_m

    def cell(self, point_xy: Floats) -> tuple[int, int]:
        """Row and column of the cell that holds a point; it may be outside of the map."""
        row, column = self.cells(point_xy[:2]).tolist()
        return row, column

    def cells(self, points_xy: Floats) -> NDArray[np.int64]:
        """``(n, 2)`` row and column of the cells that hold points ``(n, 2)``; they may be outside of the map."""
        return np.asarray(np.floor((points_xy - self._corner) / self.resolution_m).astype(np.int64)[..., ::-1])

    @property
    def known_m2(self) -> float:
        """Known area."""
        return float(self._known.sum()) * self.resolution_m**2

    @property
    def corner_xy(self) -> Floats:
        """``(2,)`` the lower left corner of cell [0, 0] (m)."""
        return self._corner

    def frontier_cells(self) -> NDArray[np.int64]:
        """``(n,)`` flat indices of all frontier cells."""
        return np.asarray(_gather(self.frontier, self._frontiers, self._tile))

    def _begin(self, resolution_m: float, origin_xy: Floats) -> None:
        if not self.empty and not math.isclose(resolution_m, self.resolution_m, rel_tol=1e-4):
            raise ValueError(f"the map's resolution is {resolution_m} m; expected {self.resolution_m} m as before")
        if not self.empty:
            return
        if not 0.0 < resolution_m < math.inf:
            raise ValueError(f"the map's resolution is {resolution_m} m; expected a positive length")
        self.resolution_m = resolution_m
        self.block = max(1, int(self.radius_m / resolution_m))
        self._tile = self.block * math.ceil(_TILE / self.block)
        self._anchor = np.array(origin_xy, np.float64)
        self._low = (0, 0)
        self._corner = self._anchor
        self.state = np.zeros((0, 0), np.int8)
        self.clearance_m = np.zeros((0, 0), np.float32)
        self.frontier = np.zeros((0, 0), np.bool_)
        self.roomy_m = np.zeros((0, 0), np.float32)
        self._known = np.zeros((0, 0), np.int64)
        self._frontiers = np.zeros((0, 0), np.int64)

    def _offset(self, origin_xy: Floats) -> tuple[int, int]:
        column, row = np.rint((np.asarray(origin_xy) - self._anchor) / self.resolution_m).astype(int).tolist()
        return row, column

    def _cover(self, row: int, column: int, rows: int, columns: int) -> None:
        """Let the arrays cover these cells, counted from the anchor."""
        tile = self._tile
        low = [math.floor(value / tile) * tile for value in (row, column)]
        high = [math.ceil(value / tile) * tile for value in (row + rows, column + columns)]
        if self.state.size:
            low = [min(a, b) for a, b in zip(low, self._low, strict=True)]
            high = [max(a, b + size) for a, b, size in zip(high, self._low, self.state.shape, strict=True)]
        shape = (high[0] - low[0], high[1] - low[1])
        if shape == self.state.shape:
            return
        shift = (self._low[0] - low[0], self._low[1] - low[1]) if self.state.size else (0, 0)
        self.state = _grown(self.state, shape, shift, 1, UNKNOWN)
        self.clearance_m = _grown(self.clearance_m, shape, shift, 1, self.comfort_m)
        self.frontier = _grown(self.frontier, shape, shift, 1, False)
        self.roomy_m = _grown(self.roomy_m, shape, shift, self.block, 0.0)
        self._known = _grown(self._known, shape, shift, tile, 0)
        self._frontiers = _grown(self._frontiers, shape, shift, tile, 0)
        self._low = (low[0], low[1])
        self._corner = self._anchor + np.array((low[1], low[0])) * self.resolution_m

    def _take(self, values: NDArray[np.int8], row: int = 0, column: int = 0) -> bool:
        """Enter values from a row and column on."""
        if len(self._marked):
            marked = self.cells(self._marked) - (row, column)
            values[tuple(marked[((marked >= 0) & (marked < values.shape)).all(axis=1)].T)] = 100
        tile, changed = self._tile, np.zeros(self._known.shape, np.int8)
        _write(self.state, values, row, column, tile, int(self.comfort_m / self.resolution_m), changed)
        if not changed.any():
            return False
        self.changes += 1
        for tile_row, tile_column in np.argwhere(changed).tolist():
            self._follow(tile_row, tile_column, bool(changed[tile_row, tile_column] == _NEAR_WALLS))
        return True

    def _follow(self, tile_row: int, tile_column: int, near_walls: bool) -> None:
        """Compute anew what follows from the cells in and around a tile; clearance only near walls that changed."""
        tile = self._tile
        row, column = tile_row * tile, tile_column * tile
        if near_walls or not self._known[tile_row, tile_column]:
            _clear(self.state, self.clearance_m, row, column, tile, self.resolution_m, self.comfort_m)
        area = self.state[row : row + tile, column : column + tile]
        self._known[tile_row, tile_column] = np.count_nonzero(area != UNKNOWN)
        _roomy(self.state, self.clearance_m, self.roomy_m, row, column, tile, self.block)
        self._frontiers[tile_row, tile_column] = _edge(self.state, self.frontier, row, column, tile)


def _grown(before: NDArray, shape: tuple[int, int], shift: tuple[int, int], unit: int, fill: float) -> NDArray:
    """An array of ``shape`` in cells, one entry a square of ``unit`` cells, that holds ``before`` at ``shift``."""
    grown = np.full((shape[0] // unit, shape[1] // unit), fill, before.dtype)
    row, column = shift[0] // unit, shift[1] // unit
    grown[row : row + before.shape[0], column : column + before.shape[1]] = before
    return grown


@njit(cache=True)
def _write(
    state: Cells, values: NDArray[np.int8], row0: int, column0: int, tile: int, reach: int, changed: NDArray[np.int8]
) -> None:
    """Enter values in percent, and mark the tiles in and beside which a cell changes, or up to ``reach`` from a wall's.
    """
    rows, columns = state.shape
    for row in range(row0, row0 + values.shape[0]):
        for column in range(column0, column0 + values.shape[1]):
            value = values[row - row0, column - column0]
            now = UNKNOWN if value < 0 or 25 < value < 65 else FREE if value <= 25 else OCCUPIED
            before = state[row, column]
            if before != now:
                state[row, column] = now
                wall = before == OCCUPIED or now == OCCUPIED
                mark, around = (_NEAR_WALLS, reach) if wall else (_NEAR, 1)
                for r in range(max(0, row - around) // tile, min(rows - 1, row + around) // tile + 1):
                    for c in range(max(0, column - around) // tile, min(columns - 1, column + around) // tile + 1):
                        changed[r, c] = max(changed[r, c], mark)


@njit(cache=True)
def _clear(
    state: Cells, clearance: NDArray[np.float32], row0: int, column0: int, tile: int, resolution: float, most: float
) -> None:
    """Distances within a tile, by a disc around each occupied cell in and around it that has a side that is not."""
    rows, columns = state.shape
    reach = int(most / resolution)
    clearance[row0 : row0 + tile, column0 : column0 + tile] = most
    for row in range(max(0, row0 - reach), min(rows, row0 + tile + reach)):
        for column in range(max(0, column0 - reach), min(columns, column0 + tile + reach)):
            if state[row, column] != 1:
                continue
            clearance_here = row0 <= row < row0 + tile and column0 <= column < column0 + tile
            if clearance_here:
                clearance[row, column] = 0.0
            if (
                0 < row < rows - 1
                and 0 < column < columns - 1
                and state[row - 1, column] == 1
                and state[row + 1, column] == 1
                and state[row, column - 1] == 1
                and state[row, column + 1] == 1
            ):
                continue
            for r in range(max(row0, row - reach), min(row0 + tile, row + reach + 1)):
                for c in range(max(column0, column - reach), min(column0 + tile, column + reach + 1)):
                    distance = np.float32(resolution * math.sqrt((r - row) ** 2 + (c - column) ** 2))
                    if distance < clearance[r, c]:
                        clearance[r, c] = distance


@njit(cache=True)
def _roomy(
    state: Cells,
    clearance: NDArray[np.float32],
    roomy: NDArray[np.float32],
    row0: int,
    column0: int,
    tile: int,
    block: int,
) -> None:
    for row in range(row0, row0 + tile, block):
        for column in range(column0, column0 + tile, block):
            best = np.float32(0.0)
            for r in range(row, row + block):
                for c in range(column, column + block):
                    if state[r, c] == 0 and clearance[r, c] > best:
                        best = clearance[r, c]
            roomy[row // block, column // block] = best


@njit(cache=True)
def _edge(state: Cells, frontier: NDArray[np.bool_], row0: int, column0: int, tile: int) -> int:
    rows, columns = state.shape
    count = 0
    for row in range(row0, row0 + tile):
        for column in range(column0, column0 + tile):
            # Beyond the array nothing is known either.
            edge = state[row, column] == 0 and (
                row == 0
                or row == rows - 1
                or column == 0
                or column == columns - 1
                or state[row - 1, column] == -1
                or state[row + 1, column] == -1
                or state[row, column - 1] == -1
                or state[row, column + 1] == -1
            )
            frontier[row, column] = edge
            count += edge
    return count


@njit(cache=True)
def _gather(frontier: NDArray[np.bool_], counts: NDArray[np.int64], tile: int) -> NDArray[np.int64]:
    found = np.empty(counts.sum(), np.int64)
    filled = 0
    columns = frontier.shape[1]
    for tile_row in range(counts.shape[0]):
        for tile_column in range(counts.shape[1]):
            if counts[tile_row, tile_column] == 0:
                continue
            for row in range(tile_row * tile, (tile_row + 1) * tile):
                for column in range(tile_column * tile, (tile_column + 1) * tile):
                    if frontier[row, column]:
                        found[filled] = row * columns + column
                        filled += 1
    return found
