"""Ray casting on the block grid: which wall face each ray hits, and how far away it is."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit


@njit(cache=True)
def cast_rays(
    walls: npt.NDArray[np.bool_],
    block_m: float,
    x: float,
    y: float,
    yaw: float,
    ray_cos: npt.NDArray[np.float64],
    ray_sin: npt.NDArray[np.float64],
    colors: npt.NDArray[np.float32],
    scan: npt.NDArray[np.float32],
) -> None:
    """Write r, g, b and depth in metres of the first wall along every ray into scan (rays, 4).

    walls: bool (height, width), its outer ring all wall. x, y, yaw: the eye in the maze's frame, m, m, rad.
    ray_cos, ray_sin: (rays,) of each ray's angle in the robot's frame. colors: float32 (height, width, 3),
    one a block. Depth is measured along the ray. The grid is traversed exactly, face by face (Amanatides and
    Woo, 1987), so there is no step size and the only error is rounding. Raises ValueError for an eye outside
    the outer ring.
    """
    eye_x, eye_y = x / block_m, y / block_m
    eye_col, eye_row = int(np.floor(eye_x)), int(np.floor(eye_y))
    if not (0 < eye_row < walls.shape[0] - 1 and 0 < eye_col < walls.shape[1] - 1):
        raise ValueError("the eye of the ray caster is not inside the maze's outer ring")
    cos_yaw, sin_yaw = np.cos(yaw), np.sin(yaw)
    for ray in range(ray_cos.shape[0]):
        along_x = cos_yaw * ray_cos[ray] - sin_yaw * ray_sin[ray]
        along_y = sin_yaw * ray_cos[ray] + cos_yaw * ray_sin[ray]
        col, row = eye_col, eye_row
        # next_*: how far along the ray the next grid line of an axis is; per_*: from one line to the next.
        step_col = 1 if along_x > 0 else -1
        step_row = 1 if along_y > 0 else -1
        per_col = 1.0 / abs(along_x) if along_x != 0.0 else np.inf
        per_row = 1.0 / abs(along_y) if along_y != 0.0 else np.inf
        line_col = eye_col + 1 - eye_x if step_col > 0 else eye_x - eye_col
        line_row = eye_row + 1 - eye_y if step_row > 0 else eye_y - eye_row
        next_col = line_col * per_col if along_x != 0.0 else np.inf
        next_row = line_row * per_row if along_y != 0.0 else np.inf
        while True:
            if next_col < next_row:
                depth = next_col
                col += step_col
                next_col += per_col
            else:
                depth = next_row
                row += step_row
                next_row += per_row
            if walls[row, col]:
                break
        scan[ray, 0] = colors[row, col, 0]
        scan[ray, 1] = colors[row, col, 1]
        scan[ray, 2] = colors[row, col, 2]
        scan[ray, 3] = depth * block_m
