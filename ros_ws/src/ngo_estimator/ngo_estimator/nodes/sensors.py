"""From sensor messages to the observations that the networks take."""

from typing import Any

import numpy as np
from sensor_msgs.msg import CompressedImage, Image, LaserScan

from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.observations import observation
from ngo_recordings.images import COMPRESSED_TYPE, IMAGE_TYPE, SCAN_TYPE, picture

_TYPE_NAMES = {Image: IMAGE_TYPE, CompressedImage: COMPRESSED_TYPE, LaserScan: SCAN_TYPE}
_ENCODINGS = {
    (1, "uint8"): ("mono8", "8UC1"),
    (3, "uint8"): ("rgb8", "bgr8", "rgba8", "bgra8"),
    (1, "float32"): ("32FC1", "16UC1"),
    (4, "float32"): ("32FC4",),
}


def sensor_topic(image_format: ImageFormat, image_topic: str, scan_topic: str, compressed: bool) -> tuple[type, str]:
    """The type of message that has such observations, and the topic of it.

    Raises ``ValueError`` for compressed images of a format that jpeg and png do not have.
    """
    if image_format.is_scan:
        return LaserScan, scan_topic
    if not compressed:
        return Image, image_topic
    if image_format.dtype != "uint8":
        raise ValueError(f"the weights take {_kind(image_format)}; expected 1 or 3 of uint8 for compressed images")
    return CompressedImage, f"{image_topic}/compressed"


def sensor_array(message: Any, image_format: ImageFormat, topic: str, scan_yaw_rad: float = 0.0) -> np.ndarray:
    """The observation in an Image, CompressedImage or LaserScan, as ``image_format`` says.

    Raises ``ValueError`` for another encoding or size, or data that contradicts the message's header.
    """
    if isinstance(message, Image):
        expected = _ENCODINGS[image_format.channels, image_format.dtype]
        if message.encoding not in expected:
            raise ValueError(f"image has the encoding '{message.encoding}'; expected {' or '.join(expected)}")
    image, scan = picture(message, _TYPE_NAMES[type(message)], topic, image_format.largest_picture)
    return observation(image_format, image, scan, scan_yaw_rad)


def _kind(image_format: ImageFormat) -> str:
    return f"{image_format.channels} channels of {image_format.dtype}"
