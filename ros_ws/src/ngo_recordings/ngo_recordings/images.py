"""Pictures, depth images and scans of ROS messages as arrays, in one form each."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from ngo_recordings.errors import RecordingError

IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_TYPE = "sensor_msgs/msg/CompressedImage"
SCAN_TYPE = "sensor_msgs/msg/LaserScan"
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
MULTI_ECHO_TYPE = "sensor_msgs/msg/MultiEchoLaserScan"
LIDAR_TYPES = (SCAN_TYPE, MULTI_ECHO_TYPE, CLOUD_TYPE)
"""Of scans, the best one first."""
SENSOR_TYPES = (IMAGE_TYPE, COMPRESSED_TYPE, SCAN_TYPE)
"""Of messages that networks take."""

MAX_PIXELS = 2**25
"""Most pixels of a picture that is decoded where its size is not known, 8K video: a few bytes may declare any size."""

_MM = 1e-3


@dataclass(frozen=True)
class _Encoding:
    """channels: as they lie in the message. take: which of them are kept, in order."""

    dtype: str
    channels: int
    take: tuple[int, ...]


_ENCODINGS = {
    "rgb8": _Encoding("u1", 3, (0, 1, 2)),
    "bgr8": _Encoding("u1", 3, (2, 1, 0)),
    "rgba8": _Encoding("u1", 4, (0, 1, 2)),
    "bgra8": _Encoding("u1", 4, (2, 1, 0)),
    "mono8": _Encoding("u1", 1, (0,)),
    "8UC1": _Encoding("u1", 1, (0,)),
    "16UC1": _Encoding("u2", 1, (0,)),
    "32FC1": _Encoding("f4", 1, (0,)),
    "32FC4": _Encoding("f4", 4, (0, 1, 2, 3)),
}
ENCODINGS = tuple(_ENCODINGS)
DEPTH_ENCODINGS = ("16UC1", "32FC1")


@dataclass(frozen=True)
class ScanGeometry:
    """Of a scan whose rays run counter-clockwise from angle_min_rad; its image has them the other way round.

    Column c of an image of n rays looks at ``angle_min_rad + (n - 1 - c) * angle_increment_rad`` from straight ahead,
    counter-clockwise; angle_increment_rad is positive.
    """

    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float


def picture(
    message: Any, type_name: str, topic: str, largest: tuple[int, int] | None = None
) -> tuple[np.ndarray, ScanGeometry | None]:
    """The image of a message of one of SENSOR_TYPES, ``(height, width, channels)``, and the geometry of a scan.

    uint8 of 1 (grey) or 3 (red, green, blue) channels, or float32 of 1 (depth in m) or 4 (colour 0 to 1, and depth);
    no return is +inf.

    Args:
        largest: height and width of the largest compressed picture that is decoded; None: MAX_PIXELS count.

    Raises:
        RecordingError: an encoding that is not supported, data of another size than the message says, or a compressed
            picture that is too large.
    """
    if type_name not in SENSOR_TYPES:
        raise RecordingError(f"topic {topic} is {type_name}; expected {', '.join(SENSOR_TYPES)}")
    if type_name == SCAN_TYPE:
        return _scan(message, topic)
    if type_name == COMPRESSED_TYPE:
        return _compressed(message, topic, largest), None
    return _raw(message, topic, message.encoding), None


def depth_picture(message: Any, topic: str) -> np.ndarray:
    """The depth in an Image ``(height, width, 1)``, m: float32, +inf where there is none; mono16 is 16UC1.

    Raises:
        RecordingError: it is no depth, or data of another size than the message says.
    """
    encoding = "16UC1" if message.encoding == "mono16" else message.encoding
    if encoding not in DEPTH_ENCODINGS:
        expected = " or ".join(DEPTH_ENCODINGS)
        raise RecordingError(f"images of {topic} are {encoding!r}; expected depth, {expected}")
    return _raw(message, topic, encoding)


def _raw(message: Any, topic: str, name: str) -> np.ndarray:
    encoding = _ENCODINGS.get(name)
    if encoding is None:
        raise RecordingError(
            f"images of {topic} are {message.encoding!r}; supported: {', '.join(ENCODINGS)}, and jpeg or png in "
            "CompressedImage: convert them, or choose another topic"
        )
    dtype = np.dtype(encoding.dtype).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * encoding.channels * dtype.itemsize
    if not height or not width or step < row or len(message.data) < step * (height - 1) + row:
        raise RecordingError(
            f"an image of {topic} has {len(message.data)} bytes; expected {height} rows of {step} bytes for "
            f"{width} x {height} {message.encoding}"
        )
    strides = (step, encoding.channels * dtype.itemsize, dtype.itemsize)
    values = np.ndarray((height, width, encoding.channels), dtype, np.ascontiguousarray(message.data), 0, strides)
    return _normalised(values[..., encoding.take])


def _normalised(values: np.ndarray) -> np.ndarray:
    """Bytes as they are; depth as float32 in m, of what is no distance +inf."""
    if values.dtype.itemsize == 1:
        return np.ascontiguousarray(values)
    if values.dtype.kind == "u":
        image = values.astype(np.float32) * np.float32(_MM)
    else:
        image = np.array(values, np.float32, order="C")
    depth = image[..., -1]
    # NaN compares false: it is no distance, too.
    depth[~(depth > 0.0)] = np.inf
    return image


def _compressed(message: Any, topic: str, largest: tuple[int, int] | None) -> np.ndarray:
    data = bytes(message.data)
    if not data.startswith((b"\xff\xd8", b"\x89PNG")):
        raise RecordingError(
            f"images of {topic} have the format {message.format!r}; supported in CompressedImage: jpeg, png"
        )
    from PIL import Image as Picture  # nodes of a lidar need no pictures

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Picture.DecompressionBombWarning)  # a lower bound counts here
            opened = Picture.open(io.BytesIO(data), formats=("JPEG", "PNG"))  # reads the header alone
        with opened:
            _check_size(*opened.size, topic, largest)
            if opened.mode.startswith("I"):
                return _normalised(np.asarray(opened).astype(np.uint16)[..., None])
            decoded = np.asarray(opened if opened.mode in ("L", "RGB") else opened.convert("RGB"))
    except RecordingError:
        raise
    except Exception as error:  # of damaged data the library raises errors of many kinds
        raise RecordingError(
            f"an image of {topic} ({len(data)} bytes of {message.format!r}) cannot be decoded: {error}"
        ) from None
    return decoded.reshape(*decoded.shape[:2], -1)


def _check_size(width: int, height: int, topic: str, largest: tuple[int, int] | None) -> None:
    """Refuse a picture by the size that it declares, before that is allocated."""
    if largest is None and width * height > MAX_PIXELS:
        raise RecordingError(f"an image of {topic} is {width} x {height}; expected at most {MAX_PIXELS} pixels")
    if largest is not None and (height > largest[0] or width > largest[1]):
        raise RecordingError(f"an image of {topic} is {width} x {height}; expected at most {largest[1]} x {largest[0]}")


def _scan(message: Any, topic: str) -> tuple[np.ndarray, ScanGeometry]:
    ranges = np.array(message.ranges, np.float32)
    increment = float(message.angle_increment)
    if not len(ranges) or not increment:
        raise RecordingError(
            f"a scan of {topic} has {len(ranges)} rays {increment:g} rad apart; expected at least one, and an increment"
        )
    low, high = float(message.range_min), float(message.range_max)
    # The standard: what is out of range is to be discarded. Some drivers leave range_max at 0.
    good = (ranges > 0.0) & (ranges >= low) & ((ranges <= high) | (high <= low))
    ranges[~good] = np.inf
    angle_min = float(message.angle_min)
    if increment > 0.0:
        ranges = ranges[::-1]
    else:  # the first ray is the leftmost already
        angle_min, increment = angle_min + (len(ranges) - 1) * increment, -increment
    return np.ascontiguousarray(ranges)[None, :, None], ScanGeometry(angle_min, increment, low, high)


def with_depth(image: np.ndarray, depth: np.ndarray, topic: str) -> np.ndarray:
    """A picture and its depth ``(height, width, 1)`` as one image: float32 ``(height, width, 4)``, colour 0 to 1.

    Raises RecordingError where they do not fit.
    """
    if image.dtype != np.uint8 or image.shape[2] != 3:
        raise RecordingError(f"depth {topic} goes with colour pictures; these have {image.shape[2]} x {image.dtype}")
    if depth.shape[:2] != image.shape[:2]:
        raise RecordingError(
            f"depth {topic} is {depth.shape[1]} x {depth.shape[0]} and the pictures are {image.shape[1]} x "
            f"{image.shape[0]}: record depth that is registered to the pictures"
        )
    return np.concatenate((image.astype(np.float32) / np.float32(255.0), depth), axis=2)
