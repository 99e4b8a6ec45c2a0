"""What of a maze's walls is in the picture of a camera of the 3D world: how far, how much of it, how many faces."""

from dataclasses import dataclass

import numpy as np

from ngo_sim.doom_map import UNITS_PER_M, WALL_HEIGHT_UNITS
from ngo_sim.maze3d import Maze3DConfig
from ngo_sim.mazes import Maze
from ngo_sim.raycast import cast_rays

EYE_M = 41.0 / UNITS_PER_M
"""Height of Doom's eye above the floor."""


@dataclass(frozen=True)
class WallView:
    """The walls in the columns of pictures.

    ``distance_m`` ``(frames, columns)`` from the eye to the first wall along each column's ray, leftmost first;
    ``depth_m``, its part straight ahead; ``faces`` ``(frames,)``, the number of different sides of blocks in view.
    """

    distance_m: np.ndarray
    depth_m: np.ndarray
    faces: np.ndarray


def column_angles_rad(camera: Maze3DConfig) -> np.ndarray:
    """Angles ``(width,)`` of the middles of a picture's columns, counter-clockwise from straight ahead."""
    offsets_px = camera.width / 2.0 - 0.5 - np.arange(camera.width)
    return np.arctan(offsets_px / camera.focal_lengths_px[0])


def filled_depth_m(camera: Maze3DConfig) -> float:
    """The depth under which a wall fills its column from top to bottom: neither floor nor ceiling is in view."""
    slope = camera.height / 2.0 / camera.focal_lengths_px[1]
    return min(EYE_M, WALL_HEIGHT_UNITS / UNITS_PER_M - EYE_M) / slope


def wall_view(maze: Maze, poses_xyyaw: np.ndarray, camera: Maze3DConfig) -> WallView:
    """The walls that the camera sees from true poses ``(frames, 3)``."""
    angles = column_angles_rad(camera)
    scans = _scans(maze, poses_xyyaw, angles)
    distance = scans[..., 3].astype(np.float64)
    return WallView(distance, distance * np.cos(angles), _faces(maze, poses_xyyaw, angles, scans))


def wall_ranges(maze: Maze, poses_xyyaw: np.ndarray, angles_rad: np.ndarray) -> np.ndarray:
    """Distances ``(frames, rays)`` in m, float32, of the first walls along ``(rays,)`` from poses ``(frames, 3)``."""
    found: np.ndarray = _scans(maze, poses_xyyaw, angles_rad)[..., 3]
    return found


def _scans(maze: Maze, poses_xyyaw: np.ndarray, angles_rad: np.ndarray) -> np.ndarray:
    """Row and column of the block that each ray ends on, a filler, and the distance: ``(frames, rays, 4)``."""
    height, width = maze.walls.shape
    numbers = np.zeros((height, width, 3), dtype=np.float32)
    numbers[..., 0] = np.arange(height)[:, None]
    numbers[..., 1] = np.arange(width)
    scans = np.empty((len(poses_xyyaw), len(angles_rad), 4), dtype=np.float32)
    rays = np.cos(angles_rad), np.sin(angles_rad)
    for (x, y, yaw), scan in zip(poses_xyyaw.tolist(), scans, strict=True):
        cast_rays(maze.walls, maze.block_m, x, y, yaw, *rays, numbers, scan)
    return scans


def _faces(maze: Maze, poses_xyyaw: np.ndarray, angles: np.ndarray, scans: np.ndarray) -> np.ndarray:
    """How many different sides of blocks each frame's rays end on; a ray that meets a corner may count for either."""
    row, col, distance = np.moveaxis(scans[..., [0, 1, 3]].astype(np.float64), -1, 0)
    direction = poses_xyyaw[:, 2:] + angles
    from_middle_x = (poses_xyyaw[:, :1] + distance * np.cos(direction)) / maze.block_m - col - 0.5
    from_middle_y = (poses_xyyaw[:, 1:2] + distance * np.sin(direction)) / maze.block_m - row - 0.5
    across_x = np.abs(from_middle_x) > np.abs(from_middle_y)
    side = np.where(across_x, from_middle_x > 0.0, 2 + (from_middle_y > 0.0))
    number = np.sort((row * maze.walls.shape[1] + col) * 4 + side, axis=1)
    found: np.ndarray = 1 + (np.diff(number, axis=1) != 0).sum(axis=1)
    return found
