"""Walls in view of the 3D world's camera, and the errors of steps by them, against mazes on paper."""

import math
from pathlib import Path

import numpy as np
import pytest

from ngo_sim.episodes import Episode
from ngo_sim.maze3d import Maze3DConfig
from ngo_sim.mazes import Maze
from training.hard_frames import Arguments
from training.hard_frames_page import draw, page
from training.hard_steps import QUANTITIES, Drive, bins_json, drive_of, hard_frames, odometry_json, turning_json
from training.validation_steps import odometry_error, step_errors
from training.wall_view import EYE_M, column_angles_rad, filled_depth_m, wall_ranges, wall_view

CAMERA = Maze3DConfig()
# One straight corridor of 3 m, free for x in [3, 18] and y in [3, 6].
CORRIDOR = Maze(np.array([[not (row == 1 and 1 <= col <= 5) for col in range(7)] for row in range(5)]), block_m=3.0)
MIDDLE_Y = 4.5


def test_columns_are_those_of_a_pinhole() -> None:
    angles = column_angles_rad(CAMERA)
    assert len(angles) == 80 and angles[0] == pytest.approx(-angles[-1])
    # Half a pixel within the borders of the field of view, the left one positive.
    assert math.radians(53.0) < angles[0] < math.radians(54.0)
    np.testing.assert_allclose(np.diff(np.tan(angles)), np.diff(np.tan(angles))[0])


def test_distances_in_a_corridor_are_those_of_trigonometry() -> None:
    view = wall_view(CORRIDOR, np.array([[9.0, MIDDLE_Y, 0.0]]), CAMERA)
    angles = column_angles_rad(CAMERA)
    to_side = 1.5 / np.abs(np.sin(angles))
    to_end = 9.0 / np.cos(angles)
    np.testing.assert_allclose(view.distance_m[0], np.minimum(to_side, to_end), rtol=1e-5)
    np.testing.assert_allclose(view.depth_m[0], view.distance_m[0] * np.cos(angles))
    # The end, and on both sides the blocks at x in [9, 18].
    assert view.faces.tolist() == [7]
    assert not hard_frames(view, CAMERA).any_near.any()


def test_ranges_along_rays_are_those_of_trigonometry() -> None:
    ranges = wall_ranges(CORRIDOR, np.array([[9.0, MIDDLE_Y, 0.0]]), np.radians([90.0, 45.0, 0.0, -30.0]))
    np.testing.assert_allclose(ranges, [[1.5, 1.5 * math.sqrt(2.0), 9.0, 3.0]], rtol=1e-5)


def test_frames_before_a_wall_are_hard() -> None:
    """0.8 m before the end of the corridor every column near the middle is near, and filled."""
    view = wall_view(CORRIDOR, np.array([[17.2, MIDDLE_Y, 0.0], [9.0, MIDDLE_Y, 0.0]]), CAMERA)
    hard = hard_frames(view, CAMERA)
    for found in (hard.near, hard.any_near, hard.near_shipped, hard.filled):
        assert found.tolist() == [True, False]
    assert view.distance_m[0].min() == pytest.approx(0.8, abs=1e-3)


def test_a_wall_fills_its_column_where_its_foot_leaves_the_picture() -> None:
    half_height_deg = math.degrees(math.atan(EYE_M / filled_depth_m(CAMERA)))
    assert half_height_deg == pytest.approx(math.degrees(math.atan(30.0 / CAMERA.focal_lengths_px[1])))
    assert filled_depth_m(CAMERA) == pytest.approx(1.49, abs=0.01)  # half a corridor
    assert filled_depth_m(Maze3DConfig(field_of_view_deg=60)) > 2.0 * filled_depth_m(CAMERA)


def drive(wrong_m: float) -> Drive:
    """Six steps ahead to the end of the corridor, the two before it estimated wrong."""
    poses = np.stack((np.linspace(14.5, 17.5, 7), np.full(7, MIDDLE_Y), np.zeros(7)), axis=1)
    episode = Episode(np.zeros((7, 1)), np.zeros(6, np.uint8), poses, 0.1, CORRIDOR)
    estimated = np.tile([0.5, 0.0, 0.0], (6, 1))
    estimated[4:, 0] += wrong_m
    return drive_of(episode, estimated, CAMERA)


def test_errors_are_counted_in_the_bins_of_their_steps() -> None:
    drives = [drive(0.1), drive(0.2)]
    assert drives[0].hard.tolist() == [False, False, False, False, True, True]
    for quantity in QUANTITIES:
        bins = bins_json(drives, quantity)
        assert sum(entry["steps"] for entry in bins) == 12
        assert sum(entry["squared_share_m"]["mean"] for entry in bins) == pytest.approx(1.0)
        assert all((entry["rmse_m"] is None) == (entry["steps"] == 0) for entry in bins)
    straight = turning_json(drives)[0]
    assert straight["others"]["rmse_m"]["mean"] == pytest.approx(0.0, abs=1e-9)
    assert straight["hard"]["rmse_m"]["mean"] == pytest.approx(math.sqrt((0.01 + 0.04) / 2))
    assert straight["hard"]["squared_share_deg"] is None or straight["hard"]["rmse_deg"]["mean"] < 1e-9


def test_true_hard_steps_take_their_part_out_of_the_odometry() -> None:
    found = odometry_json([drive(0.1), drive(0.2)])
    # 0.2 and 0.4 m at the end of 3 m.
    assert found["estimated"]["final_percent"]["mean"] == pytest.approx(10.0)
    assert found["hard_true"]["final_percent"]["mean"] == pytest.approx(0.0, abs=1e-9)
    assert found["others_true"]["final_percent"]["mean"] == pytest.approx(10.0)


def test_errors_of_steps_wrap_turns() -> None:
    errors = step_errors(np.array([[0.3, 0.4, math.pi - 0.01]]), np.array([[0.0, 0.0, -math.pi + 0.01]]))
    np.testing.assert_allclose(errors, [[0.5, -math.degrees(0.02)]])
    assert odometry_error(np.tile([1.0, 0.0, 0.0], (4, 1)), np.tile([1.0, 0.0, 0.0], (4, 1))).final_percent == 0.0


def test_what_cannot_be_is_refused() -> None:
    for changes, expected in (
        ({"mazes": 1}, "mazes, frames are 1, 1000"),
        ({"corridors_m": ()}, "is empty"),
    ):
        with pytest.raises(ValueError, match=expected):
            Arguments(**changes)


def test_page_and_figure_do_without_empty_bins(tmp_path: Path) -> None:
    drives = [drive(0.1), drive(0.2)]
    share = {"mean": 0.1, "ci95": [0.0, 0.2]}
    shares = dict.fromkeys(("near", "any_near", "near_shipped", "filled", "faces", "turn_deg", "travel_m"), share)
    world = {"corridor_m": 3.0, "field_of_view_deg": 108, "filled_depth_m": 1.5, "pixels_a_degree": 0.7, **shares}
    result = {
        "command": "python -m training.hard_frames",
        "revision": "abc",
        "mazes": 2,
        "frames": 7,
        "corridor_m": 3.0,
        "field_of_view_deg": 108,
        "bins": {one.key: bins_json(drives, one) for one in QUANTITIES},
        "turning": turning_json(drives),
        "odometry": odometry_json(drives),
        "worlds": [world],
    }
    text = page(result)
    assert "| from 0.35 | 12 |" in text and "| 3 | 108 | 10.0 [0.000, 20.0] |" in text
    path = tmp_path / "images" / "figure.png"
    draw(result, path)
    assert path.stat().st_size > 10_000
