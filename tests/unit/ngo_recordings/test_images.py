"""Images of every encoding, and what a CameraInfo says of them."""

import math
import struct
import tracemalloc
import zlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from ngo_recordings.calibration import calibration_of, info_topics, is_rectified
from ngo_recordings.errors import RecordingError
from ngo_recordings.images import COMPRESSED_TYPE, ENCODINGS, IMAGE_TYPE, SCAN_TYPE, depth_picture, picture, with_depth

from . import messages as m

RGB = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
ALPHA = np.full((4, 6, 1), 7, np.uint8)


def raw(message: Any) -> np.ndarray:
    image, scan = picture(message, IMAGE_TYPE, "/image")
    assert scan is None
    return image


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("rgba8", np.concatenate((RGB, ALPHA), 2), RGB),
        ("bgra8", np.concatenate((RGB[..., ::-1], ALPHA), 2), RGB),
        ("mono8", RGB[..., :1], RGB[..., :1]),
        ("8UC1", RGB[..., :1], RGB[..., :1]),
    ],
)
def test_colours_come_out_as_red_green_blue(
    encoding: str, pixels: np.ndarray, expected: np.ndarray, padding: int
) -> None:
    image = raw(m.image(1, pixels, encoding, padding))
    assert image.dtype == np.uint8 and image.flags.c_contiguous
    np.testing.assert_array_equal(image, expected)


@given(
    depth=arrays.arrays(np.float32, (3, 5, 1), elements=st.floats(width=32, allow_nan=True, allow_infinity=True)),
    big=st.booleans(),
)
def test_depth_is_metres_or_infinity(depth: np.ndarray, big: bool) -> None:
    image = raw(m.image(1, depth, "32FC1", big=big))
    assert image.dtype == np.float32
    good = depth > 0
    np.testing.assert_array_equal(image[good], depth[good])
    assert np.isposinf(image[~good]).all()


@pytest.mark.parametrize("big", [False, True])
def test_depth_in_millimetres_is_converted(big: bool) -> None:
    millimetres = np.array([[[1500], [0], [65535]]], np.uint16)
    image = raw(m.image(1, millimetres, "16UC1", big=big))
    np.testing.assert_allclose(image[0, :, 0], [1.5, math.inf, 65.535], rtol=1e-6)


def test_the_row_image_of_the_2d_world_keeps_its_colours_and_only_its_depth_may_be_infinite() -> None:
    row = np.array([[[0.0, 0.5, 1.0, 2.5], [0.1, 0.0, 0.2, math.nan]]], np.float32)
    np.testing.assert_array_equal(
        raw(m.image(1, row, "32FC4")), [[[0.0, 0.5, 1.0, 2.5], [np.float32(0.1), 0.0, np.float32(0.2), math.inf]]]
    )


def test_compressed_pictures_are_decoded() -> None:
    smooth = np.stack(np.meshgrid(np.arange(0, 250, 10), np.arange(0, 200, 10)), -1)
    smooth = np.concatenate((smooth, np.full((*smooth.shape[:2], 1), 90)), 2).astype(np.uint8)
    png, _ = picture(m.compressed(1, RGB, "png"), COMPRESSED_TYPE, "/image")
    np.testing.assert_array_equal(png, RGB)
    jpeg, _ = picture(m.compressed(1, smooth, "jpeg"), COMPRESSED_TYPE, "/image")
    assert jpeg.shape == smooth.shape and np.abs(jpeg.astype(int) - smooth).mean() < 3.0
    grey, _ = picture(m.compressed(1, RGB[..., :1], "png"), COMPRESSED_TYPE, "/image")
    np.testing.assert_array_equal(grey, RGB[..., :1])
    depth, _ = picture(m.compressed(1, np.full((4, 6, 1), 1234, np.uint16), "png"), COMPRESSED_TYPE, "/depth")
    np.testing.assert_allclose(depth, np.full((4, 6, 1), 1.234), rtol=1e-6)


@pytest.mark.parametrize("increment", [0.25, -0.25])
def test_a_scan_has_its_leftmost_ray_first_and_says_where_each_looks(increment: float) -> None:
    bearings = 0.5 + increment * np.arange(5)
    message = m.scan(1, 3.0 + bearings, 0.5, increment)
    image, scan = picture(message, SCAN_TYPE, "/scan")
    assert image.shape == (1, 5, 1) and image.dtype == np.float32 and scan is not None
    columns = scan.angle_min_rad + (4 - np.arange(5)) * scan.angle_increment_rad
    np.testing.assert_allclose(image[0, :, 0], 3.0 + columns, rtol=1e-6)
    assert scan.angle_increment_rad == 0.25 and (np.diff(columns) < 0).all()


def test_rays_without_a_return_are_infinite() -> None:
    ranges = np.array([0.0, 0.01, 1.0, 10.0, 10.5, math.inf, math.nan, -1.0])
    image, _ = picture(m.scan(1, ranges), SCAN_TYPE, "/scan")  # from 0.05 to 10 m
    np.testing.assert_array_equal(image[0, ::-1, 0], [math.inf, math.inf, 1.0, 10.0, *[math.inf] * 4])
    unlimited, _ = picture(m.scan(1, ranges, high=0.0), SCAN_TYPE, "/scan")
    assert unlimited[0, 3, 0] == 10.5


def test_what_is_not_supported_is_named_with_what_is() -> None:
    with pytest.raises(RecordingError) as error:
        raw(m.image(1, RGB, "yuv422_yuy2"))
    assert "'yuv422_yuy2'" in str(error.value) and all(name in str(error.value) for name in (*ENCODINGS, "jpeg", "png"))
    webp = m.compressed(1, RGB, "webp")
    with pytest.raises(RecordingError, match=r"format 'rgb8; webp compressed'; supported .* jpeg, png"):
        picture(webp, COMPRESSED_TYPE, "/image")


@pytest.mark.parametrize("missing", [1, 10])
def test_images_that_are_cut_short_are_refused(missing: int) -> None:
    short = m.image(1, RGB)
    short.data = short.data[:-missing]
    with pytest.raises(RecordingError, match=r"an image of /image has \d+ bytes; expected 4 rows of 18 bytes"):
        raw(short)
    squeezed = m.compressed(1, RGB, "png")
    squeezed.data = squeezed.data[: len(squeezed.data) - 40 - missing]
    with pytest.raises(RecordingError, match="cannot be decoded"):
        picture(squeezed, COMPRESSED_TYPE, "/image")


def declaring(width: int, height: int) -> Any:
    """A PNG of a few bytes that declares a size of its own choice, and holds one pixel."""
    message = m.compressed(1, RGB[:1, :1], "png")
    content = bytes(message.data)
    header = b"IHDR" + struct.pack(">II", width, height) + content[24:29]
    message.data = np.frombuffer(content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:], np.uint8)
    return message


@pytest.mark.parametrize("side", [13_000, 20_000, 2**31 - 1])
def test_a_picture_is_refused_by_the_size_that_it_declares(side: int) -> None:
    tracemalloc.start()
    try:
        for largest in (None, (60, 80)):
            with pytest.raises(RecordingError, match=r"^an image of /image .*(expected at most|cannot be decoded)"):
                picture(declaring(side, side), COMPRESSED_TYPE, "/image", largest)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()


def test_depth_becomes_a_fourth_channel_of_colour_alone() -> None:
    depth = np.full((4, 6, 1), 2.5, np.float32)
    image = with_depth(RGB, depth, "/depth")
    assert image.shape == (4, 6, 4) and image.dtype == np.float32
    np.testing.assert_allclose(image[..., :3] * 255.0, RGB, atol=1e-4)
    assert (image[..., 3] == 2.5).all()
    with pytest.raises(RecordingError, match="depth /depth is 6 x 2 and the pictures are 6 x 4"):
        with_depth(RGB, depth[:2], "/depth")
    with pytest.raises(RecordingError, match="goes with colour pictures"):
        with_depth(RGB[..., :1], depth, "/depth")
    with pytest.raises(RecordingError, match="are 'rgb8'; expected depth, 16UC1 or 32FC1"):
        depth_picture(m.image(0, RGB, "rgb8"), "/depth")


MATRIX = [400.0, 0.0, 320.0, 0.0, 400.0, 240.0, 0.0, 0.0, 1.0]
PROJECTION = [300.0, 0.0, 320.0, 0.0, 0.0, 300.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]


def info(model: str, coefficients: list[float], projection: list[float]) -> Any:
    return SimpleNamespace(
        width=640,
        height=480,
        k=MATRIX,
        p=projection,
        d=coefficients,
        distortion_model=model,
        header=SimpleNamespace(frame_id="camera"),
    )


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/camera/image_rect", True),
        ("/camera/image_rect_color/compressed", True),
        ("/camera/rectified", True),
        ("/camera/image_direct", False),
        ("/rect/image_raw", False),
        ("/camera/image_raw/compressed", False),
    ],
)
def test_the_last_part_of_a_topic_says_whether_pictures_are_rectified(topic: str, rectified: bool) -> None:
    assert is_rectified(topic) == rectified


def test_rectified_pictures_of_a_fisheye_are_those_of_a_pinhole() -> None:
    found = calibration_of(info("equidistant", [0.1, 0.01, 0.0, 0.0], PROJECTION), "/info", "/camera/image_rect")
    assert found.distortion == "plumb_bob" and len(found.coefficients) == 0
    assert found.matrix[0, 0] == 300.0


def test_the_matrix_that_is_used_is_the_one_that_is_checked() -> None:
    broken = info("plumb_bob", [0.0] * 5, [300.0, 0.0, np.nan, *PROJECTION[3:]])
    assert calibration_of(broken, "/info", "/camera/image_raw").matrix[0, 0] == 400.0
    with pytest.raises(RecordingError, match=r"/info says that the camera is not calibrated \(p is \[300.0, 0.0, nan"):
        calibration_of(broken, "/info", "/camera/image_rect")
    nothing = info("plumb_bob", [0.0] * 5, [0.0] * 12)
    assert calibration_of(nothing, "/info", "/camera/image_rect").matrix[0, 0] == 400.0


def test_calibrations_are_one_level_up_for_compressed_pictures_alone() -> None:
    assert info_topics("/camera/image_raw", False) == ("/camera/camera_info",)
    assert info_topics("/camera/image_raw/compressed", True) == ("/camera/image_raw/camera_info", "/camera/camera_info")
