"""Drives of a camera through rooms of another renderer, as a second look on what was tuned on ViZDoom's pictures.

The renderer is pybullet's, and so are the textures. It is no requirement of the project:
``.venv/bin/python -m pip install pybullet==3.2.7``.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.camera_model import CameraModel, tilted
from training.scoring.camera_rows import CameraDrive, given_motion

_SIZE, _FIELD_DEG, _EYE_M = (640, 480), 60.0, 0.5
_PERIOD_S, _STEP_M = 0.07, 0.07
_ROOM_M, _WALL_M = (12.0, 9.0), 2.5
_PANEL_M = 1.5
"""Length of a wall with one texture."""

_FURNITURE = 14
_LEAST_TEXTURE = 64
"""Pixels of a picture's sides that is a texture."""


def room_drive(seed: int, frames: int) -> CameraDrive:
    """Rounds through a room whose walls, furniture and textures are drawn, with wheels as ``given_motion`` has them.

    Raises:
        ValueError: pybullet is not installed.
    """
    rng = np.random.default_rng([seed, 49])
    with _room(rng) as bullet:
        poses = _rounds(rng, frames)
        pictures = [_picture(bullet, pose) for pose in poses]
    focal = 0.5 * _SIZE[1] / np.tan(np.radians(0.5 * _FIELD_DEG))
    matrix = np.array(((focal, 0.0, 0.5 * (_SIZE[0] - 1)), (0.0, focal, 0.5 * (_SIZE[1] - 1)), (0.0, 0.0, 1.0)))
    camera = CameraModel(*_SIZE, matrix, "plumb_bob", np.zeros(0), tilted(0.0, _EYE_M))
    truth = se2.between(poses[:1], poses)
    return CameraDrive(pictures, truth, given_motion(truth, seed), camera, _PERIOD_S)


@contextlib.contextmanager
def _room(rng: np.random.Generator) -> Iterator[Any]:
    """pybullet, with a room in it."""
    try:
        import pybullet
        import pybullet_data
    except ImportError as error:
        raise ValueError("pybullet is not installed; expected `pip install pybullet==3.2.7` before") from error
    client = pybullet.connect(pybullet.DIRECT)
    try:
        textures = [pybullet.loadTexture(str(path)) for path in _pictures_of(Path(pybullet_data.getDataPath()))]

        def box(x: float, y: float, sides: tuple[float, float, float], bottom: float = 0.0, yaw: float = 0.0) -> None:
            half = 0.5 * np.array(sides)
            shape = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=half)
            turned = pybullet.getQuaternionFromEuler((0.0, 0.0, yaw))
            body = pybullet.createMultiBody(0, -1, shape, (x, y, bottom + half[2]), turned)
            pybullet.changeVisualShape(body, -1, textureUniqueId=textures[rng.integers(len(textures))])

        along, across = _ROOM_M
        for x in np.arange(0.5 * _PANEL_M, along, _PANEL_M):
            for y in (0.0, across):
                box(x, y, (_PANEL_M, 0.1, _WALL_M))
        for y in np.arange(0.5 * _PANEL_M, across, _PANEL_M):
            for x in (0.0, along):
                box(x, y, (0.1, _PANEL_M, _WALL_M))
        for x in np.arange(0.5, along):
            for y in np.arange(0.5, across):
                box(x, y, (1.0, 1.0, 0.02), bottom=-0.02)
        for x in (5.2, 6.0, 6.8):  # what the rounds go round
            box(x, 0.5 * across, (0.8, 1.6, 2.2))
        for angle in rng.uniform(0.0, 2.0 * np.pi, _FURNITURE):
            far, (length, width), height = rng.uniform(1.0, 1.05), rng.uniform(0.3, 0.7, 2), rng.uniform(0.4, 1.4)
            x, y = 0.5 * along + 4.9 * far * np.cos(angle), 0.5 * across + 3.6 * far * np.sin(angle)
            box(x, y, (length, width, height), yaw=rng.uniform(0.0, np.pi))
        yield pybullet
    finally:
        pybullet.disconnect(client)


def _pictures_of(folder: Path) -> list[Path]:
    """All pictures below a folder that are large enough for a wall, in order."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix in (".png", ".jpg"))
    sizes = {path: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths}
    return [path for path, read in sizes.items() if read is not None and min(read.shape) >= _LEAST_TEXTURE]


def _rounds(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Poses ``(frames, 3)`` on rounds that wander, at an even pace; the heading swings about the way."""
    phases, rounds = rng.uniform(0.0, 2.0 * np.pi, 3), frames * _STEP_M / 15.0 + 0.1
    angle = np.linspace(0.0, 2.0 * np.pi * rounds, 40 * frames)
    far = 1.0 + 0.12 * np.sin(2.31 * angle + phases[0]) + 0.08 * np.sin(3.05 * angle + phases[1])
    x, y = 0.5 * _ROOM_M[0] + 2.9 * far * np.cos(angle), 0.5 * _ROOM_M[1] + 2.3 * far * np.sin(angle)
    way = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
    at = _STEP_M * np.arange(frames)
    x, y = np.interp(at, way, x), np.interp(at, way, y)
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x))) + 0.5 * np.sin(0.9 * at + phases[2])
    return np.stack((x, y, heading), axis=1)


def _picture(bullet: Any, pose: np.ndarray) -> np.ndarray:
    """What the camera sees from a pose ``(3,)``: grey ``(height, width)``."""
    (x, y, heading), (width, height) = pose, _SIZE
    view = bullet.computeViewMatrix((x, y, _EYE_M), (x + np.cos(heading), y + np.sin(heading), _EYE_M), (0.0, 0.0, 1.0))
    lens = bullet.computeProjectionMatrixFOV(_FIELD_DEG, width / height, 0.05, 30.0)
    rgb = bullet.getCameraImage(
        width, height, view, lens, renderer=bullet.ER_TINY_RENDERER, lightDirection=(3, 2, 10), shadow=0
    )[2]
    colours = np.asarray(rgb, np.uint8).reshape(height, width, 4)[..., :3]
    return cv2.cvtColor(np.ascontiguousarray(colours), cv2.COLOR_RGB2GRAY)
