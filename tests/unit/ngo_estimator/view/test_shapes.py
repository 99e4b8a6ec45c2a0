import numpy as np
import pytest

from ngo_estimator.view.shapes import ellipse, known_corners, scan_points, shown_picture, window_around
from ngo_recordings.mounting import Mounting
from ngo_recordings.scan_stream import LidarScan


def test_the_ellipse_has_two_standard_deviations_along_its_axes() -> None:
    turned = np.pi / 6
    axes = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = axes @ np.diag([0.09, 0.01]) @ axes.T
    seen = (ellipse(np.array([1.0, 2.0, 0.3]), covariance) - [1.0, 2.0]) @ axes
    np.testing.assert_allclose((seen / [0.6, 0.2]) ** 2 @ np.ones(2), 1.0)
    assert ellipse(np.zeros(3), np.zeros((3, 3))) == pytest.approx(0.0)


def scan(ranges: list[float]) -> LidarScan:
    return LidarScan(0, 0.0, np.pi / 2, np.array(ranges, np.float32), 0.1, 10.0, 0.0, "laser")


def test_hits_of_a_scan_are_those_within_its_limits_where_the_scanner_sits() -> None:
    seen = scan([1.0, 2.0, np.inf, np.nan, 0.05, 11.0])
    np.testing.assert_allclose(scan_points(seen, None, np.array([5.0, 0.0, 0.0])), [[6, 0], [5, 2]], atol=1e-9)
    hanging = Mounting("base_link", "laser", np.array([0.5, 0.0, 0.0]), True, 0.0, 0.2, "/tf_static")
    pose = np.array([0.0, 0.0, np.pi / 2])
    np.testing.assert_allclose(scan_points(seen, hanging, pose), [[0, 1.5], [2, 0.5]], atol=1e-9)


def test_every_kind_of_observation_becomes_a_picture() -> None:
    colour = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    assert shown_picture(colour) is colour
    rays = np.ones((1, 5, 4), np.float32) * [0.0, 0.5, 1.0, 7.0]
    strip = shown_picture(rays.astype(np.float32))
    assert strip.dtype == np.uint8 and strip.shape[1:] == (5, 3) and len(strip) > 10
    assert strip[3, 2].tolist() == [0, 128, 255]
    depth = np.array([[[0.0], [1.0]], [[2.0], [np.inf]]], np.float32)
    assert shown_picture(depth)[..., 0].tolist() == [[255, 128], [0, 0]]


def test_the_known_part_of_a_grid() -> None:
    cells = np.full((20, 30), -1, np.int8)
    assert known_corners(cells, 0.1, np.zeros(3)).shape == (0, 2)
    cells[5, 10], cells[7, 3] = 0, 100
    corners = known_corners(cells, 0.1, np.array([1.0, 2.0, 0.0]))
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [[1.3, 2.5], [2.1, 2.8]])
    turned = known_corners(cells, 0.1, np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose([turned.min(axis=0), turned.max(axis=0)], [[-0.8, 0.3], [-0.5, 1.1]])


def test_a_window_has_room_for_the_path_to_grow() -> None:
    low, high = np.array([0.0, 0.0]), np.array([10.0, 4.0])
    window = window_around(low, high)
    assert window.holds(low - 0.5, high + 0.5) and not window.holds(low, high + 10.0)
    assert window_around(low, low).half_m > 1.0, "a robot that stands is not looked at through a microscope"
