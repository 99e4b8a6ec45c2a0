"""How well a scan at a pose fits the lines of others."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.line_map import LineMap
from ngo_estimator.geometry.planar_motion import Array
from ngo_estimator.geometry.scan_matching import IcpConfig, nearest


def misfit(lines: LineMap, points: Array, normals: Array, pose: Array, config: IcpConfig | None = None) -> float:
    """Mean squared distance (m^2) of points with normals, at a ``pose`` ``(3,)``, from the lines that face as they do.

    Each counts at most as much as one at the last gate, and so does a scan without normals. Shapes are as in ``icp``.
    """
    config = config or IcpConfig()
    return float(
        _misfit(
            lines.points,
            lines.normals,
            lines.first,
            lines.corner,
            lines.shape[0],
            lines.shape[1],
            points,
            normals,
            pose,
            config.last_gate_m,
            math.cos(math.radians(config.facing_deg)),
        )
    )


@njit(cache=True)
def _misfit(
    map_points: Array,
    map_normals: Array,
    first: NDArray[np.int64],
    corner: Array,
    rows: int,
    columns: int,
    points: Array,
    normals: Array,
    pose: Array,
    gate: float,
    facing: float,
) -> float:
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    squares, tried = 0.0, 0
    for i in range(len(points)):
        nx, ny = normals[i, 0], normals[i, 1]
        if nx == 0.0 and ny == 0.0:
            continue
        tried += 1
        x = cos * points[i, 0] - sin * points[i, 1] + pose[0]
        y = sin * points[i, 0] + cos * points[i, 1] + pose[1]
        turned_x, turned_y = cos * nx - sin * ny, sin * nx + cos * ny
        best = nearest(map_points, map_normals, first, corner, rows, columns, x, y, turned_x, turned_y, facing)
        distance = gate
        if best >= 0:
            distance = map_normals[best, 0] * (x - map_points[best, 0]) + map_normals[best, 1] * (
                y - map_points[best, 1]
            )
        squares += min(distance * distance, gate * gate)
    return squares / tried if tried else gate * gate
