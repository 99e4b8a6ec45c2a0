"""What a CameraInfo says of its camera, checked."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from ngo_recordings.errors import RecordingError

CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"

_MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
_SAME_MODELS = {"": "plumb_bob", "fisheye": "equidistant", "none": "plumb_bob"}
_RECTIFIED = re.compile(r"(^|_)rect(_|$|ified)")


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera, whose frame is frame_id.

    width, height: pixels. matrix ``(3, 3)``: of the pinhole. distortion: plumb_bob, rational_polynomial or equidistant,
    with its coefficients ``(n,)``; none of them: rectified pictures.
    """

    width: int
    height: int
    matrix: np.ndarray
    distortion: str
    coefficients: np.ndarray
    frame_id: str


def info_topics(image_topic: str, compressed: bool) -> tuple[str, ...]:
    """Topics where the CameraInfo of an image may be: beside it, for compressed pictures also one level up."""
    parent = image_topic.rpartition("/")[0]
    spaces = (parent, parent.rpartition("/")[0])[: 1 + compressed]
    return tuple(f"{space}/camera_info" for space in spaces if space or image_topic[:1] == "/")


def is_rectified(image_topic: str) -> bool:
    """Whether the topic's name says that its pictures, compressed or not, have no distortion."""
    return _RECTIFIED.search(image_topic.removesuffix("/compressed").rpartition("/")[2]) is not None


def calibration_of(info: Any, topic: str, image_topic: str) -> Calibration:
    """The camera of a CameraInfo on a topic, as the pictures on image_topic show it: rectified ones have no distortion.

    Raises:
        RecordingError: it is not calibrated, or of a model that is not known.
    """
    matrix, projection, found = (
        np.asarray(getattr(info, name, getattr(info, name.upper(), ())), np.float64) for name in ("k", "p", "d")
    )
    width, height, name = int(info.width), int(info.height), str(info.distortion_model)
    model, letter = _SAME_MODELS.get(name, name), "k"
    if is_rectified(image_topic):
        model, found = "plumb_bob", np.zeros(0)
        if projection.size == 12 and projection[0] != 0.0:
            matrix, letter = projection.reshape(3, 4)[:, :3].ravel(), "p"
    if matrix.size != 9 or not np.isfinite(matrix).all() or not (matrix[0] > 0.0 and matrix[4] > 0.0):
        raise RecordingError(
            f"{topic} says that the camera is not calibrated ({letter} is {matrix.tolist()}): calibrate it"
        )
    if not (width > 0 and height > 0):
        raise RecordingError(f"{topic} is of pictures of {width} x {height}; expected their size")
    if not found.any():
        found = np.zeros(0)
    if model not in _MODELS or len(found) not in (0, *_MODELS[model]) or not np.isfinite(found).all():
        raise RecordingError(
            f"{topic} has the distortion {name!r} with {len(found)} numbers; expected {', '.join(_MODELS)}"
        )
    frame = str(info.header.frame_id).strip("/")
    return Calibration(width, height, matrix.reshape(3, 3), model, found, frame)
