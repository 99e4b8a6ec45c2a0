"""What the live view draws."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ngo_estimator.view.live_view import LiveView
from ngo_estimator.view.shapes import ellipse, known_corners, scan_points, shown_picture, window_around
from ngo_estimator.view.tracks import StampedPoses, Track, begun_with_identity, placed, position_rmse_m
from ngo_recordings.mounting import Mounting
from ngo_recordings.scan_stream import LidarScan
from ngo_recordings.transform_buffer import TransformBuffer

S = 1_000_000_000


class Notes:
    """A canvas: the arguments of the last call of each kind, and how often each came."""

    url = "http://nowhere"

    def __init__(self) -> None:
        self.last: dict[str, Any] = {}
        self.counts: dict[str, int] = {}

    def __getattr__(self, name: str) -> Any:
        def note(*arguments: Any) -> None:
            key = f"{name} {arguments[0]}" if name in ("path", "error") else name
            self.last[key] = arguments
            self.counts[key] = self.counts.get(key, 0) + 1

        return note


@pytest.fixture
def notes() -> Notes:
    return Notes()


def drive(view: LiveView, frames: int) -> np.ndarray:
    """A straight drive: the odometry is 10 % long, the corrected path right, the truth in a frame of its own."""
    x = np.arange(frames, dtype=np.float64)
    for frame in range(frames):
        view.tracks["truth"].append((1 + frame) * S, np.array([7.0, 3.0 + x[frame], np.pi / 2]))
        if frame:  # as local_node, which has nothing to say about the first frame
            view.tracks["odometry"].append((1 + frame) * S, np.array([1.1 * x[frame], 0.0, 0.0]))
    view.show_trajectory((1 + np.arange(frames)) * S, np.stack([x, 0 * x, 0 * x], axis=1))
    return x


def test_trajectories_are_drawn_in_the_frame_of_the_map_with_their_errors(notes: Notes) -> None:
    view = LiveView(notes)
    x = drive(view, 6)
    np.testing.assert_allclose(notes.last["path truth"][1], np.stack([x, 0 * x], axis=1), atol=1e-9)
    np.testing.assert_allclose(notes.last["path odometry"][1], np.stack([1.1 * x, 0 * x], axis=1), atol=1e-9)
    np.testing.assert_array_equal(notes.last["path corrected"][1], np.stack([x, 0 * x], axis=1))
    assert notes.last["error corrected"][1] == pytest.approx(0.0, abs=1e-9)
    assert notes.last["error odometry"][1] == pytest.approx(0.1 * np.sqrt((x**2).mean()))
    assert "**6 frames**" in notes.last["text"][0] and "odometry: position RMSE **0.303 m**" in notes.last["text"][0]


def test_the_view_moves_when_the_path_leaves_it_and_not_before(notes: Notes) -> None:
    view = LiveView(notes)
    for frames in range(2, 40):
        drive(view, frames)
    assert 2 <= notes.counts["look_at"] <= 25
    window = notes.last["look_at"][0]
    assert window.holds(np.zeros(2), np.array([38.0, 0.0]))


def test_the_whole_map_is_looked_at(notes: Notes) -> None:
    view = LiveView(notes)
    drive(view, 5)
    view.show_map(np.zeros((400, 400), np.int8), 0.1, np.array([-30.0, -5.0, 0.0]))
    window = notes.last["look_at"][0]
    assert window.holds(np.array([-30.0, -5.0]), np.array([10.0, 35.0]))
    looks = notes.counts["look_at"]
    drive(view, 8)
    assert notes.counts["look_at"] == looks, "the path lies within the map"


def test_time_goes_on_when_the_source_restarts(notes: Notes) -> None:
    view, times = LiveView(notes), []
    for stamp_s in (100, 101, 101, 103, 1, 2):
        view.show_pose(stamp_s * S, np.zeros(3), np.eye(3))
        times.append(notes.last["at"][0])
    assert times == [0.0, 1.0, 1.0, 3.0, 3.0, 4.0]


def test_a_scan_is_drawn_at_the_corrected_pose(notes: Notes) -> None:
    view = LiveView(notes)
    view.show_pose(S, np.array([1.0, 2.0, np.pi]), np.zeros((3, 3)))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id="laser")
    limits = {"range_min": 0.1, "range_max": 9.0, "time_increment": 0.0}
    angles = {"angle_min": 0.0, "angle_max": 0.2, "angle_increment": 0.1}
    message = SimpleNamespace(header=header, ranges=[4.0, np.inf, np.inf], **limits, **angles)
    view.show_scan(message, "scan", TransformBuffer(), "base_link")
    np.testing.assert_allclose(notes.last["scan"][0], [[-3.0, 2.0]], atol=1e-9)


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


def poses(*rows: tuple[float, float, float, float]) -> StampedPoses:
    """Rows of time (s), x, y, yaw."""
    values = np.array(rows)
    return StampedPoses((values[:, 0] * S).astype(np.int64), values[:, 1:])


def track(*rows: tuple[float, float, float, float]) -> Track:
    made, values = Track(), poses(*rows)
    for stamp, pose in zip(values.stamps_ns.tolist(), values.poses_xyyaw, strict=True):
        made.append(stamp, pose)
    return made


def test_a_track_keeps_its_poses_in_order_and_begins_anew_with_its_source() -> None:
    made = track((1, 0, 0, 0), (2, 1, 0, 0), (2, 9, 9, 0), (1.5, 9, 9, 0))
    assert made.stamps_ns.tolist() == [S, 2 * S]
    np.testing.assert_array_equal(made.poses_xyyaw[:, 0], [0.0, 1.0])
    made.append(S, np.array([5.0, 6.0, 7.0]))  # 1 s back
    assert made.stamps_ns.tolist() == [S]
    np.testing.assert_array_equal(made.poses_xyyaw, [[5.0, 6.0, 7.0]])


def test_poses_between_stamps_turn_the_short_way() -> None:
    between = poses((0, 0, 0, 3.0), (1, 2, 4, -3.0)).at(np.array([S // 2]))
    np.testing.assert_allclose(between[0, :2], [1.0, 2.0])
    assert abs(between[0, 2]) == pytest.approx(np.pi)


def test_a_track_is_laid_over_the_first_pose_that_it_shares() -> None:
    """The truth is known from 1 s on, in a frame that is turned by 90 degrees."""
    corrected = poses((0, 0, 0, 0), (1, 1, 0, 0), (2, 2, 0, 0))
    truth = poses((1, 5, 5, np.pi / 2), (2, 5, 6, np.pi / 2), (3, 4, 6, np.pi))
    here = placed(truth, corrected)
    assert here is not None
    np.testing.assert_allclose(here.poses_xyyaw, [[1, 0, 0], [2, 0, 0], [2, 1, np.pi / 2]], atol=1e-12)
    assert placed(poses((8, 0, 0, 0)), corrected) is None


def test_odometry_begins_with_the_identity_in_the_first_frame_alone() -> None:
    corrected = poses((1, 4, 4, 0), (2, 5, 4, 0), (3, 6, 4, 0))
    heard_from_the_start = begun_with_identity(track((2, 1, 0, 0), (3, 2, 0, 0)), corrected)
    assert heard_from_the_start.stamps_ns.tolist() == [S, 2 * S, 3 * S]
    np.testing.assert_array_equal(heard_from_the_start.poses_xyyaw[0], np.zeros(3))
    for rows in ([(3.0, 2.0, 0.0, 0.0)], [(0.5, 7.0, 7.0, 0.0), (2.0, 8.0, 7.0, 0.0)]):
        own = begun_with_identity(track(*rows), corrected)
        assert len(own.stamps_ns) == len(rows), "heard late, or the robot's own from before"


def test_the_error_is_the_rmse_over_the_stamps_that_both_cover() -> None:
    truth = poses((0, 0, 0, 0), (4, 4, 0, 0))
    off = poses((1, 1, 3, 0), (2, 2, 4, 0), (9, 9, 9, 0))
    assert position_rmse_m(off, truth, np.array([1, 2, 8]) * S) == pytest.approx(np.sqrt((9 + 16) / 2))
    assert position_rmse_m(off, truth, np.array([8 * S])) is None
