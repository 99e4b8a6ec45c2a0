"""Sensor messages of every kind become what the networks take, over the wire, and what cannot be used is named."""

import io
import math
from typing import Any

import numpy as np
import pytest
from PIL import Image as Picture
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image, LaserScan

from ngo_estimator.data.images import ImageFormat, scan_image
from ngo_estimator.nodes.sensors import sensor_array, sensor_topic
from tests.unit.ngo_estimator.samples import SCAN

ROW = ImageFormat(1, 9, 4, "float32")
COLOUR = ImageFormat(3, 8, 3, "uint8")
GREY = ImageFormat(3, 8, 1, "uint8")
DEPTH = ImageFormat(3, 8, 1, "float32")


def over_the_wire(message: Any) -> Any:
    return deserialize_message(serialize_message(message), type(message))


def image(pixels: np.ndarray, encoding: str, padding: int = 0) -> Image:
    """A message of these pixels; rows may be longer than the pixels in them."""
    height, width = pixels.shape[:2]
    rows = [row.tobytes() + bytes(padding) for row in pixels]
    return Image(height=height, width=width, encoding=encoding, step=len(rows[0]), data=b"".join(rows))


def row() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.01, 1.0, ROW.shape).astype(np.float32)


def picture(image_format: ImageFormat = COLOUR) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, image_format.shape, dtype=np.uint8)


def compressed(pixels: np.ndarray, kind: str, **options: Any) -> CompressedImage:
    buffer = io.BytesIO()
    Picture.fromarray(pixels).save(buffer, kind, **options)
    return CompressedImage(format=kind, data=buffer.getvalue())


def laser(ranges: np.ndarray, first_deg: float, step_deg: float, **changes: float) -> LaserScan:
    settings = {"range_min": 0.1, "range_max": 30.0, **changes}
    first, step = math.radians(first_deg), math.radians(step_deg)
    last = first + step * (len(ranges) - 1)
    return LaserScan(angle_min=first, angle_max=last, angle_increment=step, ranges=ranges.tolist(), **settings)


@pytest.mark.parametrize("padding", [0, 4, 13])
def test_images_are_read_whatever_the_length_of_their_rows(padding: int) -> None:
    colour, depth = picture(), row()[..., 3:].repeat(3, axis=0)[:, :8]
    for pixels, encoding, image_format, expected in (
        (colour, "rgb8", COLOUR, colour),
        (colour[..., ::-1], "bgr8", COLOUR, colour),
        (picture(GREY), "mono8", GREY, picture(GREY)),
        (depth, "32FC1", DEPTH, depth),
        (row(), "32FC4", ROW, row()),
    ):
        read = sensor_array(over_the_wire(image(pixels, encoding, padding)), image_format, "image")
        np.testing.assert_array_equal(read, expected)
        image_format.check(read)


def test_a_compressed_image_larger_than_the_weights_take_is_not_decoded() -> None:
    whole = compressed(np.zeros((4000, 4000), np.uint8), "png")
    whole.data = whole.data[:100]  # its header alone: to decode it would fail in another way
    with pytest.raises(ValueError, match=r"is 4000 x 4000; expected at most 8 x 3$"):
        sensor_array(whole, GREY, "image/compressed")
    halved = ImageFormat(3, 8, 1, "uint8", reduction=2)
    assert sensor_array(compressed(np.zeros((7, 17), np.uint8), "png"), halved, "image").shape == GREY.shape


@pytest.mark.parametrize(("first_deg", "step_deg", "rays"), [(-150, 1.25, 241), (0, 0.5, 720), (90, -1.0, 180)])
def test_scans_of_any_geometry_are_resampled(first_deg: float, step_deg: float, rays: int) -> None:
    ranges = np.random.default_rng(1).uniform(1.0, 9.0, rays).astype(np.float32)
    message = over_the_wire(laser(ranges, first_deg, step_deg))
    read = sensor_array(message, SCAN, "scan")
    # Angles of a LaserScan are single precision, and an edge of the view may fall on either side of a ray.
    expected = scan_image(SCAN, ranges, message.angle_min, message.angle_increment, 0.1, 30.0)
    np.testing.assert_allclose(read, expected, rtol=1e-4)
    SCAN.check(read)


def test_a_scanner_that_is_mounted_turned_is_turned_back() -> None:
    ranges = np.where(np.arange(360) < 90, 1.0, 3.0)  # a near wall from 0 to 90 degrees of the scanner
    read = sensor_array(laser(ranges, 0.0, 1.0), SCAN, "scan", math.radians(-90.0)).ravel()
    degrees = np.degrees(SCAN.ray_angles_rad)
    assert (read[(degrees > -89) & (degrees < -2)] == 1.0).all() and (read[degrees > 2] == 3.0).all()


def unusable() -> list[tuple[Any, ImageFormat, str]]:
    short = image(row(), "32FC4")
    short.data = short.data[:-16]
    return [
        (image(row()[:, :8], "32FC4"), ROW, "image is 8 x 1 pixels of 4 x float32; expected 9 x 1 pixels"),
        (image(picture(), "rgb8"), ROW, "image has the encoding 'rgb8'; expected 32FC4"),
        (image(picture(), "yuv422"), COLOUR, "encoding 'yuv422'; expected rgb8 or bgr8"),
        (image(picture(GREY), "mono8"), COLOUR, "encoding 'mono8'; expected rgb8"),
        (Image(encoding="rgb8"), COLOUR, "has 0 bytes"),
        (short, ROW, "has 128 bytes"),
        (compressed(picture(), "png"), GREY, "pixels of 3 x uint8; expected 8 x 3 pixels of 1 x uint8"),
        (CompressedImage(format="h264", data=bytes(9)), COLOUR, "format 'h264'; supported"),
        (CompressedImage(format="png", data=b"\x89PNG" + bytes(9)), COLOUR, "cannot be decoded"),
        (laser(np.ones(5), 0.0, 0.0), SCAN, "5 rays 0 rad apart"),
        (LaserScan(angle_increment=0.1), SCAN, "0 rays"),
        (laser(np.ones(5), 0.0, 1.0), COLOUR, "laser scan of 5 rays; expected 8 x 3"),
        (image(row()[..., :1], "32FC1"), SCAN, "expected a laser scan"),
    ]


@pytest.mark.parametrize(("message", "image_format", "reason"), unusable(), ids=[reason for *_, reason in unusable()])
def test_what_cannot_be_used_is_named(message: Any, image_format: ImageFormat, reason: str) -> None:
    with pytest.raises(ValueError, match=r"image|scan") as error:
        sensor_array(message, image_format, "the_topic")
    assert reason in str(error.value) and "\n" not in str(error.value)


def test_the_format_of_the_weights_says_what_is_subscribed() -> None:
    assert sensor_topic(SCAN, "image", "scan", False) == (LaserScan, "scan")
    assert sensor_topic(COLOUR, "image", "scan", False) == (Image, "image")
    assert sensor_topic(COLOUR, "/camera/image", "scan", True) == (CompressedImage, "/camera/image/compressed")
    with pytest.raises(ValueError, match="4 channels of float32; expected 1 or 3 of uint8"):
        sensor_topic(ROW, "image", "scan", True)
