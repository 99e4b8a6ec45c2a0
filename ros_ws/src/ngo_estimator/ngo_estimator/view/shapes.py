"""Shapes and pictures of a live view as plain arrays."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry.planar_motion import transformed
from ngo_recordings.mounting import Mounting
from ngo_recordings.scan_stream import LidarScan

_ELLIPSE_POINTS = 48
_SIGMAS = 2.0
_ROWS_OF_A_LINE = 40
_MARGIN = 1.3


def ellipse(pose_xyyaw: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Outline ``(points, 2)`` of two standard deviations of a position, with a covariance ``(3, 3)``."""
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    angle = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(pose_xyyaw[:2] + _SIGMAS * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def scan_points(scan: LidarScan, mounting: Mounting | None, pose_xyyaw: np.ndarray) -> np.ndarray:
    """Hits ``(m, 2)`` of a scan, in the frame in which the robot has the pose ``(3,)``.

    Without a mounting the scanner is taken to sit at the robot's pose, looking ahead.
    """
    hits = scan.hits()
    return np.asarray(transformed(pose_xyyaw, hits if mounting is None else mounting.on_robot(hits)))


def shown_picture(image: np.ndarray) -> np.ndarray:
    """An observation ``(height, width, channels)`` as bytes, ``(height, width, 1 or 3)``.

    Colour of 0 to 1 becomes bytes, depth becomes grey from near to far, a single row of rays becomes a strip.
    """
    if image.shape[2] == 4:
        image = np.round(255.0 * np.clip(image[..., :3], 0.0, 1.0)).astype(np.uint8)
    elif image.dtype != np.uint8:
        far = np.max(image, initial=1e-6, where=np.isfinite(image))
        image = np.round(255.0 * (1.0 - np.clip(image / far, 0.0, 1.0))).astype(np.uint8)
    return np.repeat(image, _ROWS_OF_A_LINE, axis=0) if len(image) == 1 else image


def known_corners(cells: np.ndarray, resolution_m: float, origin_xyyaw: np.ndarray) -> np.ndarray:
    """Corners ``(4, 2)`` of the part of an occupancy grid that is known; none, ``(0, 2)``, where nothing is."""
    rows, columns = (np.flatnonzero((cells >= 0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return np.zeros((0, 2))
    x = resolution_m * np.array([columns[0], columns[-1] + 1])
    y = resolution_m * np.array([rows[0], rows[-1] + 1])
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    return np.asarray(transformed(origin_xyyaw, corners))


@dataclass(frozen=True)
class Window:
    """A square of the map that a view looks at: its middle and half its side, m."""

    x: float
    y: float
    half_m: float

    def holds(self, low: np.ndarray, high: np.ndarray) -> bool:
        """Whether it holds the rectangle from ``low`` to ``high``, both ``(2,)``."""
        middle = np.array([self.x, self.y])
        return bool((low >= middle - self.half_m).all() and (high <= middle + self.half_m).all())


def window_around(low: np.ndarray, high: np.ndarray) -> Window:
    """The window around a rectangle, with a margin for it to grow."""
    x, y = (0.5 * (low + high)).tolist()
    return Window(x, y, _MARGIN * 0.5 * max(float((high - low).max()), 2.0))
