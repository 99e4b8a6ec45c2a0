"""Points with normals in a grid of cells: the lines that other scans are registered to."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.planar_motion import Array

CELL_M = 0.4
"""Side of a cell, and how far along its line a point may be from the point that it is compared with."""

_FARTHEST_M = 120.0
"""Points farther than this from the middle point are left out, so that the grid's memory is bounded."""


@dataclass(frozen=True, eq=False)
class LineMap:
    """Points ``(n, 2)`` that have normals ``(n, 2)``, in the order of their cells; those of cell ``c`` of ``shape``
    (rows, columns) are ``first[c]`` to ``first[c + 1]``. ``corner`` ``(2,)`` is the grid's least x and y."""

    points: Array
    normals: Array
    first: NDArray[np.int64]
    corner: Array
    shape: tuple[int, int]


def line_map_of_points(points: Array, normals: Array) -> LineMap:
    """The lines at points ``(n, 2)`` with normals ``(n, 2)``, zero where there is none."""
    points, normals, low, high = _lines(points, normals)
    if (high - low).max() >= _FARTHEST_M:  # else no point is as far from the middle one
        near = np.abs(points - np.median(points, axis=0)).max(axis=1) < _FARTHEST_M
        points, normals, low, high = _lines(points[near], normals[near])
    corner = low - CELL_M if len(points) else np.zeros(2)
    extent = high - corner
    shape = (int(extent[1] / CELL_M) + 2, int(extent[0] / CELL_M) + 2)
    return LineMap(*_in_cells(points, normals, corner, shape[0], shape[1]), corner, shape)


@njit(cache=True)
def _lines(points: Array, normals: Array) -> tuple[Array, Array, Array, Array]:
    """Finite points that have normals ``(m, 2)``, these normals, and the least and largest coordinates ``(2,)``."""
    on_lines, facing = np.empty_like(points), np.empty_like(normals)
    low, high = np.full(2, math.inf), np.full(2, -math.inf)
    count = 0
    for i in range(len(points)):
        if normals[i, 0] == 0.0 and normals[i, 1] == 0.0:
            continue
        if not (math.isfinite(points[i, 0]) and math.isfinite(points[i, 1])):
            continue  # it lies in no cell
        for axis in range(2):
            value = points[i, axis]
            on_lines[count, axis], facing[count, axis] = value, normals[i, axis]
            low[axis], high[axis] = min(low[axis], value), max(high[axis], value)
        count += 1
    if count == 0:
        low[:], high[:] = 0.0, 0.0
    return on_lines[:count].copy(), facing[:count].copy(), low, high


@njit(cache=True)
def line_squares(points: Array, normals: Array, side: float = 0.06) -> NDArray[np.int64]:
    """Numbers ``(n,)`` of the squares of a side (m), and of the eighth of a turn of the normals, that points lie in.

    Points without normals have -1.
    """
    squares = np.empty(len(points), dtype=np.int64)
    for i in range(len(points)):
        if normals[i, 0] == 0.0 and normals[i, 1] == 0.0:
            squares[i] = -1
            continue
        row, column = math.floor(points[i, 1] / side), math.floor(points[i, 0] / side)
        direction = math.floor((math.atan2(normals[i, 1], normals[i, 0]) / math.pi + 1.125) * 4.0) % 8
        # 30 bits for either coordinate: thousands of kilometres.
        squares[i] = (((row + (1 << 29)) << 30 | (column + (1 << 29))) << 3) | direction
    return squares


def averaged_lines(points: Array, normals: Array, squares: NDArray[np.int64]) -> tuple[Array, Array]:
    """Points and normals ``(m, 2)``, averaged over the points that lie in the same square.

    ``squares`` ``(n,)`` are their numbers by ``line_squares``; points with -1 are left out. Averages are less noisy
    than single points, and fewer.
    """
    averages: tuple[Array, Array] = _averaged(points, normals, squares, np.argsort(squares))
    return averages


@njit(cache=True)
def _averaged(
    points: Array, normals: Array, squares: NDArray[np.int64], order: NDArray[np.int64]
) -> tuple[Array, Array]:
    mean_points, mean_normals = np.empty_like(points), np.empty_like(normals)
    count, begin = 0, 0
    while begin < len(order) and squares[order[begin]] < 0:
        begin += 1
    while begin < len(order):
        square, end = squares[order[begin]], begin
        x, y, normal_x, normal_y = 0.0, 0.0, 0.0, 0.0
        while end < len(order) and squares[order[end]] == square:
            i = order[end]
            x, y = x + points[i, 0], y + points[i, 1]
            normal_x, normal_y = normal_x + normals[i, 0], normal_y + normals[i, 1]
            end += 1
        size, length = end - begin, math.hypot(normal_x, normal_y)
        mean_points[count, 0], mean_points[count, 1] = x / size, y / size
        mean_normals[count, 0], mean_normals[count, 1] = normal_x / length, normal_y / length
        count, begin = count + 1, end
    return mean_points[:count].copy(), mean_normals[:count].copy()


@njit(cache=True)
def _in_cells(
    points: Array, normals: Array, corner: Array, rows: int, columns: int
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Points and normals in the order of their cells, and where those of each cell begin."""
    cells = np.empty(len(points), dtype=np.int64)
    first = np.zeros(rows * columns + 1, dtype=np.int64)
    for i in range(len(points)):
        row = math.floor((points[i, 1] - corner[1]) / CELL_M)
        column = math.floor((points[i, 0] - corner[0]) / CELL_M)
        cells[i] = row * columns + column
        first[cells[i] + 1] += 1
    for c in range(rows * columns):
        first[c + 1] += first[c]
    place = first.copy()
    ordered, facing = np.empty_like(points), np.empty_like(normals)
    for i in range(len(points)):
        at = place[cells[i]]
        place[cells[i]] += 1
        for axis in range(2):
            ordered[at, axis], facing[at, axis] = points[i, axis], normals[i, axis]
    return ordered, facing, first
