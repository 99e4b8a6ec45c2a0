"""A calibrated camera on a robot: pixels to rays in the robot's base frame, and back."""

from dataclasses import dataclass

import cv2
import numpy as np

Array = np.ndarray

DISTORTIONS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
"""The models of ``sensor_msgs/CameraInfo`` that are known, and how many coefficients each may have."""

LOOKING_AHEAD = np.array(((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))
"""Axes of an optical frame (z ahead, x right, y down) in a base frame (x ahead, y left, z up), looking ahead."""

_UP = 0.71
"""Of an axis within 45 degrees from straight up."""

_UNDISTORTED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)


@dataclass(frozen=True, eq=False)
class CameraModel:
    """Where a pixel looks.

    Attributes:
        width, height: of a picture, pixels.
        matrix: ``(3, 3)`` of the pinhole: focal lengths and principal point, pixels.
        distortion: the model's name, one of ``DISTORTIONS``.
        coefficients: of the distortion.
        base_from_camera: ``(3, 4)``: axes of the optical frame in the base frame, and its origin there (m).
    """

    width: int
    height: int
    matrix: Array
    distortion: str
    coefficients: Array
    base_from_camera: Array

    def __post_init__(self) -> None:
        if self.distortion not in DISTORTIONS:
            raise ValueError(f"the distortion is {self.distortion!r}; expected one of {', '.join(DISTORTIONS)}")
        if len(self.coefficients) not in (0, *DISTORTIONS[self.distortion]):
            raise ValueError(
                f"{self.distortion} has {len(self.coefficients)} coefficients; expected "
                f"{' or '.join(map(str, DISTORTIONS[self.distortion]))}, or none"
            )
        if self.matrix.shape != (3, 3) or self.base_from_camera.shape != (3, 4):
            raise ValueError(
                f"matrix and base_from_camera are {self.matrix.shape} and {self.base_from_camera.shape}; expected "
                "(3, 3) and (3, 4)"
            )
        if not (self.matrix[0, 0] > 0.0 and self.matrix[1, 1] > 0.0):
            raise ValueError(
                f"focal lengths are {self.matrix[0, 0]:g} and {self.matrix[1, 1]:g} pixels; expected positive ones: "
                "the camera is not calibrated"
            )

    @property
    def centre(self) -> Array:
        """Where the camera is in the base frame ``(3,)``, m."""
        return self.base_from_camera[:, 3]

    @property
    def pixel_rad(self) -> float:
        """The angle that a pixel sees in the middle of the picture."""
        return float(2.0 / (self.matrix[0, 0] + self.matrix[1, 1]))

    @property
    def description(self) -> str:
        """The lens in words."""
        across = np.degrees(
            np.arccos(np.clip(np.dot(*self.rays(np.array(((0.0, 0.5), (1.0, 0.5))) * self._size)), -1, 1))
        )
        lens = self.distortion if len(self.coefficients) else "no distortion"
        return f"{across:.0f} deg from left to right, {lens}"

    @property
    def _size(self) -> Array:
        return np.array((self.width, self.height), np.float64)

    def rays(self, pixels: Array) -> Array:
        """Unit vectors ``(n, 3)`` along which pixels ``(n, 2)`` look, in the axes of the base frame."""
        if len(pixels) == 0:
            return np.zeros((0, 3))
        at = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
        if self.distortion == "equidistant":
            flat = cv2.fisheye.undistortPoints(at, self.matrix, self._coefficients)
        else:
            flat = cv2.undistortPointsIter(at, self.matrix, self._coefficients, np.eye(3), np.eye(3), _UNDISTORTED)
        rays: Array = np.concatenate((flat.reshape(-1, 2), np.ones((len(pixels), 1))), axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        seen: Array = rays @ self.base_from_camera[:, :3].T
        return seen

    def pixels(self, rays: Array) -> tuple[Array, np.ndarray]:
        """Pixels ``(n, 2)`` that look along rays ``(n, 3)`` in base axes, and whether each is before the camera."""
        if len(rays) == 0:
            return np.zeros((0, 2)), np.zeros(0, bool)
        seen = rays @ self.base_from_camera[:, :3]
        ahead = seen[:, 2] > 1e-3 * np.linalg.norm(rays, axis=1)
        flat = np.where(ahead[:, None], seen, (0.0, 0.0, 1.0)).reshape(-1, 1, 3)
        nothing = np.zeros(3)
        if self.distortion == "equidistant":
            projected = cv2.fisheye.projectPoints(flat, nothing, nothing, self.matrix, self._coefficients)[0]
        else:
            projected = cv2.projectPoints(flat, nothing, nothing, self.matrix, self._coefficients)[0]
        return projected.reshape(-1, 2), ahead

    @property
    def _coefficients(self) -> Array:
        return self.coefficients if len(self.coefficients) else np.zeros(4)


def tilted(pitch_rad: float, height_m: float, forward_m: float = 0.0) -> Array:
    """``base_from_camera`` ``(3, 4)`` of a camera that looks ahead, and down by a pitch."""
    cos, sin = np.cos(pitch_rad), np.sin(pitch_rad)
    down = np.array(((cos, 0.0, sin), (0.0, 1.0, 0.0), (-sin, 0.0, cos)))
    return np.column_stack((down @ LOOKING_AHEAD, (forward_m, 0.0, height_m)))


def camera_mounting(position: Array, axes: Array, optical: bool = False) -> Array:
    """``base_from_camera`` ``(3, 4)`` of a camera's frame with this ``position`` ``(3,)`` and ``axes`` ``(3, 3)``.

    Pictures are of an optical frame, whose z looks ahead. Drivers that stamp them with the camera's body, whose z is
    up, are understood: no camera of a robot looks straight up. One that looks up steeply needs to be ``optical``.
    """
    body = not optical and axes[2, 2] > _UP
    return np.column_stack((axes @ LOOKING_AHEAD if body else axes, position))
