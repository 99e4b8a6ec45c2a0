"""What a CameraInfo says of the pictures on a topic."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ngo_recordings.calibration import calibration_of, info_topics, is_rectified
from ngo_recordings.errors import RecordingError

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
