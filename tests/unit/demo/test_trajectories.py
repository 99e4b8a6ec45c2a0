import math
from pathlib import Path

import numpy as np
import pytest

from demo.picture import save_picture
from demo.trajectories import Trajectories, evaluate, match, summarise
from ngo_sim.mazes import prim_maze


def square(yaw: float = 0.0) -> np.ndarray:
    """Three poses 3 m and 4 m apart, driving along x, then along y."""
    return np.array([[0.0, 0.0, yaw], [3.0, 0.0, yaw + math.pi / 2], [3.0, 4.0, yaw + math.pi / 2]])


def trajectories(truth: np.ndarray, odometry: np.ndarray, corrected: np.ndarray) -> Trajectories:
    return Trajectories(np.arange(len(truth)), truth, odometry, corrected, len(truth))


def test_errors_computed_on_paper() -> None:
    odometry = square()
    odometry[1] += [0.0, 1.0, math.radians(20.0)]  # 1 m off
    odometry[2] += [2.0, 0.0, math.radians(-20.0) + 2 * math.pi]  # 2 m off
    corrected = square()
    corrected[2, 0] += 0.7  # 10 % of 7 m
    result = evaluate("maze2d", 5, trajectories(square(), odometry, corrected))
    assert list(result) == ["world", "seed", "frames", "path_m", "odometry", "corrected"]
    assert (result["world"], result["seed"], result["frames"], result["path_m"]) == ("maze2d", 5, 3, 7.0)
    assert result["odometry"] == {
        "position_rmse_m": pytest.approx(math.sqrt(5 / 3), abs=1e-4),
        "final_percent": pytest.approx(200 / 7, abs=1e-4),
        "heading_rmse_deg": pytest.approx(math.sqrt(800 / 3), abs=1e-4),
    }
    assert result["corrected"] == {
        "position_rmse_m": pytest.approx(0.7 / math.sqrt(3), abs=1e-4),
        "final_percent": pytest.approx(10.0),
        "heading_rmse_deg": 0.0,
    }


def test_estimates_are_compared_from_the_first_pose_on() -> None:
    # The same drive, begun at (10, 20) with heading 90 degrees: x becomes y, y becomes -x.
    truth = np.array([[10.0, 20.0, math.pi / 2], [10.0, 23.0, math.pi], [6.0, 23.0, math.pi]])
    poses = trajectories(truth, square(), square())
    result = evaluate("maze2d", 5, poses)
    assert result["odometry"]["position_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert result["odometry"]["heading_rmse_deg"] == pytest.approx(0.0, abs=1e-9)
    placed = poses.in_maze(square())
    np.testing.assert_allclose(placed[:, :2], truth[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.remainder(placed[:, 2] - truth[:, 2] + 1.0, 2 * math.pi), 1.0)


def test_poses_are_matched_by_stamp_and_odometry_starts_at_the_identity() -> None:
    truth = {stamp: np.full(3, stamp) for stamp in (10, 20, 30, 40)}
    odometry = {stamp: np.full(3, 2 * stamp) for stamp in (20, 30, 40)}
    corrected = {stamp: np.full(3, 3 * stamp) for stamp in (30, 10, 20)}  # one frame was lost
    poses = match(truth, odometry, corrected)
    np.testing.assert_array_equal(poses.stamps_ns, [10, 20, 30])
    np.testing.assert_array_equal(poses.truth[:, 0], [10, 20, 30])
    np.testing.assert_array_equal(poses.odometry[:, 0], [0, 40, 60])
    np.testing.assert_array_equal(poses.corrected[:, 0], [30, 60, 90])
    assert poses.frames_published == 4


def test_summary_counts_wins_and_takes_medians() -> None:
    def result(seed: int, before: float, after: float) -> dict:
        errors = (
            {"position_rmse_m": value, "final_percent": 0.0, "heading_rmse_deg": 0.0} for value in (before, after)
        )
        return {
            "world": "maze2d",
            "seed": seed,
            "frames": 3,
            "path_m": 7.0,
            **dict(zip(("odometry", "corrected"), errors, strict=True)),
        }

    summary = summarise([result(1, 1.0, 0.5), result(2, 2.0, 3.0), result(3, 4.0, 1.0)])
    assert summary["wins"] == 2 and summary["mazes"] == 3 and summary["seeds"] == [1, 2, 3]
    assert summary["median_position_rmse_m"] == {"odometry": 2.0, "corrected": 1.0}
    assert summary["reduction_of_median_percent"] == 50.0
    assert summary["median_reduction_percent"] == 50.0


def test_picture_shows_maze_and_trajectories(tmp_path: Path) -> None:
    maze = prim_maze(3, 3, np.random.default_rng(0))
    truth = np.array([[1.5, 1.5, 0.0], [2.5, 1.5, 0.0], [3.5, 1.5, 0.0]])
    odometry = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [12.0, 0.3, 0.0]])  # leaves the maze
    poses = trajectories(truth, odometry, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    path = tmp_path / "new" / "picture.png"
    save_picture(path, maze, poses, evaluate("maze2d", 0, poses))
    assert path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000
