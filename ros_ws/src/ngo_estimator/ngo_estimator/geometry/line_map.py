"""Points with normals in a grid of cells: the lines that other scans are registered to."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import Array, rotated, transformed

CELL_M = 0.4
"""Side of a cell, and how far along its line a point may be from the point that it is compared with."""

_FARTHEST_M = 120.0
"""Points farther than this from the middle point are left out, so that the grid's memory is bounded."""


@dataclass(frozen=True, eq=False)
class LineMap:
    """Points ``(n, 2)`` that have normals ``(n, 2)``, in the order of their cells; those of cell ``c`` of ``shape`` (rows,
    columns) are ``first[c]`` to ``first[c + 1]``. ``corner`` ``(2,)`` is the grid's least x and y."""

    points: Array
    normals: Array
    first: NDArray[np.int64]
    corner: Array
    shape: tuple[int, int]


def line_map(scans: Sequence[KeyScan], poses: Sequence[Array]) -> LineMap:
    """The lines of scans whose base frames have the given poses ``(3,)``, in the frame of these.

    Raises:
        ValueError: there are no scans, or not one pose a scan.
    """
    if not scans or len(scans) != len(poses):
        raise ValueError(f"{len(scans)} scans and {len(poses)} poses given; expected as many of both, at least one")
    return line_map_of_points(
        np.concatenate([transformed(pose, scan.points) for scan, pose in zip(scans, poses, strict=True)]),
        np.concatenate([rotated(pose[2], scan.normals) for scan, pose in zip(scans, poses, strict=True)]),
    )


def line_map_of_points(points: Array, normals: Array) -> LineMap:
    """The lines at points ``(n, 2)`` with normals ``(n, 2)``, zero where there is none."""
    has_line = (normals[:, 0] != 0.0) | (normals[:, 1] != 0.0)
    points, normals = points[has_line], normals[has_line]
    if len(points):
        near = np.abs(points - np.median(points, axis=0)).max(axis=1) < _FARTHEST_M
        points, normals = points[near], normals[near]
    corner = points.min(axis=0) - CELL_M if len(points) else np.zeros(2)
    extent = points.max(axis=0) - corner if len(points) else np.zeros(2)
    shape = (int(extent[1] / CELL_M) + 2, int(extent[0] / CELL_M) + 2)
    first, order = _cells(points, corner, shape[0], shape[1])
    return LineMap(points[order], normals[order], first, corner, shape)


@njit(cache=True)
def _cells(points: Array, corner: Array, rows: int, columns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    cells = np.empty(len(points), dtype=np.int64)
    first = np.zeros(rows * columns + 1, dtype=np.int64)
    for i in range(len(points)):
        row = int(math.floor((points[i, 1] - corner[1]) / CELL_M))
        column = int(math.floor((points[i, 0] - corner[0]) / CELL_M))
        cells[i] = row * columns + column
        first[cells[i] + 1] += 1
    for c in range(rows * columns):
        first[c + 1] += first[c]
    place = first.copy()
    order = np.empty(len(points), dtype=np.int64)
    for i in range(len(points)):
        order[place[cells[i]]] = i
        place[cells[i]] += 1
    return first, order
