"""How much of a map is right: its free and occupied cells beside those of the true maze."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ngo_estimator.mapping.occupancy_grid import OccupancyConfig, OccupancyGrid, OccupancyMap
from ngo_estimator.mapping.range_scan import range_scan
from training.data.batches import seen_from_first
from training.data.episodes import wall_ranges

if TYPE_CHECKING:
    from ngo_sim.mazes import Maze

_UNKNOWN, _FREE, _OCCUPIED = -1, 0, 100
_POINTS = 5  # of a cell along each side, which tell whether a wall's surface crosses it
_FAR_M = 1000.0


def true_map(maze: Maze, poses_xyyaw: np.ndarray, angles_rad: np.ndarray, resolution_m: float) -> OccupancyMap:
    """The cells that exact rays from the true poses see, in the frame of the first pose.

    A cell that a wall's surface crosses is occupied, one within a corridor is free.

    Args:
        poses_xyyaw: in the maze's frame ``(frames, 3)``; angles_rad: of the rays ``(rays,)``, in the robot's frame.
    """
    from_first = seen_from_first(poses_xyyaw)
    ranges = wall_ranges(maze, poses_xyyaw, angles_rad).astype(np.float64)
    grid = OccupancyGrid(resolution_m)
    for pose, seen in zip(from_first, ranges, strict=True):
        grid.add([range_scan(angles_rad, seen, np.zeros(3), _FAR_M)], pose[None])
    seen_map = grid.cells(OccupancyConfig())
    rows, columns = np.nonzero(seen_map.values != _UNKNOWN)
    walls = np.zeros(len(rows), np.int64)
    for x in np.arange(0.5, _POINTS) / _POINTS:
        for y in np.arange(0.5, _POINTS) / _POINTS:
            at = seen_map.origin_xy + resolution_m * np.column_stack((columns + x, rows + y))
            walls += _is_wall(maze, poses_xyyaw[0], at)
    values = np.full(seen_map.values.shape, _UNKNOWN, np.int8)
    values[rows, columns] = np.select([walls == 0, walls < _POINTS**2], [_FREE, _OCCUPIED], _UNKNOWN)
    return OccupancyMap(values, resolution_m, seen_map.origin_xy)


def intersections(found: OccupancyMap, true: OccupancyMap) -> tuple[float, float]:
    """Intersection over union of the free and of the occupied cells of two trinary maps of one resolution."""
    low = np.minimum(_corner(found), _corner(true))
    high = np.maximum(_corner(found) + found.values.shape[::-1], _corner(true) + true.values.shape[::-1])
    both = [_on_canvas(each, low, high) for each in (found, true)]
    free, occupied = (
        ((both[0] == value) & (both[1] == value)).sum() / max(1, ((both[0] == value) | (both[1] == value)).sum())
        for value in (_FREE, _OCCUPIED)
    )
    return float(free), float(occupied)


def _is_wall(maze: Maze, first: np.ndarray, points: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(first[2]), np.sin(first[2])
    x = first[0] + cos * points[:, 0] - sin * points[:, 1]
    y = first[1] + sin * points[:, 0] + cos * points[:, 1]
    rows, columns = (np.floor(along / maze.block_m).astype(int) for along in (y, x))
    height, width = maze.walls.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    walls: np.ndarray = ~inside | maze.walls[rows.clip(0, height - 1), columns.clip(0, width - 1)]
    return walls


def _corner(found: OccupancyMap) -> np.ndarray:
    """Column and row of the map's first cell, counted from the cell round the frame's origin."""
    corner: np.ndarray = np.rint(found.origin_xy / found.resolution_m + 0.5).astype(int)
    return corner


def _on_canvas(found: OccupancyMap, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    canvas = np.full((high - low)[::-1], _UNKNOWN, np.int8)
    column, row = _corner(found) - low
    rows, columns = found.values.shape
    canvas[row : row + rows, column : column + columns] = found.values
    return canvas
