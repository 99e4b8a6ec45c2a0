"""The demo: its nodes, its errors and its pictures."""

import json
import math
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from demo import run
from demo.explore_picture import in_frame_above, in_frame_of
from demo.graph import Graph, GraphError, NodeSpec
from demo.picture import save_picture
from demo.session import SessionConfig
from demo.trajectories import Trajectories, evaluate, match, summarise
from ngo_sim.mazes import prim_maze


def fake_result(seed: int) -> dict[str, Any]:
    errors = [{"position_rmse_m": m, "final_percent": 1.0, "heading_rmse_deg": 2.0} for m in (2.0, 1.0)]
    return {"world": "maze2d", "seed": seed, "frames": 30, "path_m": 9.0, "odometry": errors[0], "corrected": errors[1]}


def fake_run_one(arguments: Any, seed: int, out: Path, console: Any, view: Any = None) -> dict[str, Any]:
    return fake_result(seed)


def test_last_line_is_the_result(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any) -> None:
    monkeypatch.setattr(run, "run_one", fake_run_one)
    assert run.main(["--world", "maze2d", "--seed", "2003", "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == fake_result(2003)
    assert json.loads((tmp_path / "result.json").read_text()) == fake_result(2003)


def test_several_mazes_end_with_a_summary(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any) -> None:
    monkeypatch.setattr(run, "run_one", fake_run_one)
    assert run.main(["--world", "maze2d", "--mazes", "3", "--out", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    summary = json.loads(output.splitlines()[-1])
    assert summary["seeds"] == [2000, 2001, 2002] and summary["wins"] == 3
    assert "3 of 3 mazes better" in " ".join(output.split())
    assert json.loads((tmp_path / "summary.json").read_text()) == summary


def test_a_failed_graph_is_one_message_and_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any
) -> None:
    def fail(*_: Any) -> None:
        raise GraphError("ngo_node ended with exit code 2")

    monkeypatch.setattr(run, "run_one", fail)
    assert run.main(["--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == "demo: ngo_node ended with exit code 2\n"


@pytest.mark.parametrize("argument", ["--frames=2", "--mazes=0", "--rate=-1", "--rate=nan", "--seed=-1"])
def test_refuses_what_makes_no_sense(argument: str, capsys: Any) -> None:
    with pytest.raises(SystemExit):
        run.parse_arguments([argument])
    assert "is not allowed; at least" in capsys.readouterr().err


def test_a_view_shows_one_maze(capsys: Any) -> None:
    assert run.parse_arguments(["--view"]).view and not run.parse_arguments([]).view
    with pytest.raises(SystemExit):
        run.parse_arguments(["--view", "--mazes", "2"])
    assert "it shows one maze" in capsys.readouterr().err


class LongNode(NodeSpec):
    """A process that runs for an hour in place of a node."""

    def command(self) -> list[str]:
        """The command line."""
        return [sys.executable, "-c", "import time; time.sleep(3600)"]


def test_ctrl_c_while_a_node_starts_leaves_no_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def interrupted(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(start(*arguments, **options))
        signal.raise_signal(signal.SIGINT)
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", interrupted)
    with pytest.raises(KeyboardInterrupt), Graph(tmp_path, domain_id=1) as graph:
        graph.start(LongNode("package", "node"))
    assert started[0].wait(60) != 0


class FailingNode(NodeSpec):
    """A process that ends as a node does which cannot start."""

    def command(self) -> list[str]:
        """The command line."""
        return [sys.executable, "-c", "import sys; print('there is no folder /nowhere'); sys.exit(2)"]


def test_it_says_which_node_failed_and_what_it_wrote(tmp_path: Path) -> None:
    said = r"node ended with exit code 2; it wrote last:\n *there is no folder /nowhere"
    with Graph(tmp_path, domain_id=1) as graph:
        graph.start(FailingNode("package", "node"))
        with pytest.raises(GraphError, match=said):
            graph.wait_for(lambda: False, "what never comes", 60.0)


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


def test_the_map_may_be_written_where_the_results_go(tmp_path: Path) -> None:
    nodes = {spec.executable: spec.parameters for spec in SessionConfig("maze2d", 2000, 30).estimators(tmp_path)}
    assert nodes["ngo_map"]["save_directory"] == str(tmp_path), "the working directory may be another one"


def test_what_is_three_metres_ahead_of_a_robot_that_looks_along_y() -> None:
    pose = np.array((1.0, 2.0, np.pi / 2))
    np.testing.assert_allclose(in_frame_above(np.array(((3.0, 0.0), (0.0, 1.0))), pose), ((1.0, 5.0), (0.0, 2.0)))


def test_there_and_back_is_the_same_place() -> None:
    pose, points = np.array((-4.0, 7.0, 2.2)), np.random.default_rng(0).normal(size=(20, 2))
    np.testing.assert_allclose(in_frame_of(in_frame_above(points, pose), pose), points)
