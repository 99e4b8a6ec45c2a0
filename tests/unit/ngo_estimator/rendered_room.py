"""A camera's pictures of a room with walls that are painted at random, by casting a ray a pixel."""

import numpy as np

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.camera_model import CameraModel, tilted
from ngo_estimator.geometry.planar_views import turn_matrices
from ngo_estimator.geometry.view_pose import camera_at

SIZE_M = np.array((8.0, 6.0, 3.0))
_CELL_M = 0.12
PLAIN = np.random.default_rng(5).integers(0, 256, (6, 80, 80)).astype(np.float64)
TILES = np.tile(PLAIN[:, :3, :3], (1, 27, 27))[:, :80, :80]  # Paint of walls that repeat each 0.36 m.


def camera(width: int = 320) -> CameraModel:
    """A camera that looks a little down and to the side, with a lens that distorts."""
    height, focal = width * 3 // 4, 0.6 * width
    matrix = np.array(((focal, 0.0, width / 2), (0.0, focal, height / 2), (0.0, 0.0, 1.0)))
    mounted = tilted(0.1, 0.9, 0.2)
    mounted[:, :3] = turn_matrices(np.array((0.15,)))[0] @ mounted[:, :3]
    return CameraModel(width, height, matrix, "plumb_bob", np.array((-0.15, 0.02, 0.001, -0.001, 0.0)), mounted)


def rays_of(model: CameraModel) -> np.ndarray:
    """The ray of each pixel ``(height * width, 3)``, in base axes."""
    across, down = np.meshgrid(np.arange(model.width), np.arange(model.height))
    return model.rays(np.stack((across.ravel(), down.ravel()), axis=1).astype(np.float64))


def picture(model: CameraModel, rays: np.ndarray, pose: np.ndarray, walls: np.ndarray = PLAIN) -> np.ndarray:
    """What the camera of a robot at ``pose`` ``(3,)`` sees, ``(height, width, 1)`` uint8."""
    origin = camera_at(pose, model.centre)
    towards = rays @ turn_matrices(pose[2:])[0].T
    with np.errstate(divide="ignore"):
        reach = (np.where(towards > 0.0, SIZE_M, 0.0) - origin) / towards
    wall = reach.argmin(1)
    hit = origin + towards * np.take_along_axis(reach, wall[:, None], axis=1)
    rows = np.arange(len(rays))
    across, up = hit[rows, (wall + 1) % 3] / _CELL_M, hit[rows, (wall + 2) % 3] / _CELL_M
    paint = 2 * wall + (towards[rows, wall] > 0.0)
    i, j = np.floor(across).astype(int) % 80, np.floor(up).astype(int) % 80
    a, b = across % 1.0, up % 1.0
    near, far = walls[paint, i, j], walls[paint, (i + 1) % 80, j]
    side, corner = walls[paint, i, (j + 1) % 80], walls[paint, (i + 1) % 80, (j + 1) % 80]
    grey = (1 - a) * (1 - b) * near + a * (1 - b) * far + (1 - a) * b * side + a * b * corner
    return grey.reshape(model.height, model.width, 1).astype(np.uint8)


def drive(frames: int) -> np.ndarray:
    """Poses ``(frames, 3)`` round the room, one round in 60 frames."""
    angle = np.arange(frames) * (2.0 * np.pi / 60)
    x, y = 4.0 + 1.6 * np.cos(angle), 3.0 + 1.2 * np.sin(angle)
    ahead = np.arctan2(1.2 * np.cos(angle), -1.6 * np.sin(angle))
    return np.stack((x, y, ahead), axis=1)


def by_wheels(truth: np.ndarray, turn_rad: float = 0.01) -> np.ndarray:
    """The drive ``(frames, 3)`` as wheels count it that turn too far by an angle in each step, and go 2 % too far."""
    poses = np.zeros_like(truth)
    for k, step in enumerate(se2.between(truth[:-1], truth[1:])):
        poses[k + 1] = se2.compose(poses[k], step * (1.02, 1.02, 1.0) + (0.0, 0.0, turn_rad))
    return poses
