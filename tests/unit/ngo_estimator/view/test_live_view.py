"""What a view draws, on a canvas that writes down what it is told."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ngo_estimator.view.live_view import LiveView
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
