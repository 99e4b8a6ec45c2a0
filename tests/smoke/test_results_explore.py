"""The tables of exploration at toy size: every number is there, and two robots that explore for longer see more."""

import json
from pathlib import Path

import numpy as np
import pytest

from ngo_explorer.settings import DriveConfig, ExplorerConfig
from training.data.explored_worlds import Maze, Sight
from training.data.lidar_drives import TruePoses
from training.results_explore import Arguments, Maze2DConfig, main
from training.scoring.exploring import ENOUGH, Seen, TruePosesMap, drive_known_tour, explore

pytestmark = pytest.mark.slow


class DriftsSteadily(TruePosesMap):
    """Knows the true poses, and claims to be as wrong as it has driven for long."""

    def take(self, sight: Sight) -> None:
        super().take(sight)
        self.time_s = sight.time_s

    def errors(self, truth: TruePoses) -> dict[str, float]:
        return {"ate_m": self.time_s}


TINY = Maze2DConfig(rows=2, cols=2)


def test_the_tables_of_two_mazes(tmp_path: Path) -> None:
    folders = {"out": tmp_path, "docs": tmp_path, "runs": tmp_path / "runs"}
    rows = ("nearest", "explore_lite", "ours")
    main(Arguments(worlds=("mazes",), split="validation", count=2, rows=rows, most_s=12.0, **folders))
    result = json.loads((tmp_path / "explore.json").read_text())
    table = result["tables"]["mazes"]
    assert sorted(table) == sorted(rows)
    for entry in table.values():
        assert 0.0 < entry["coverage"]["mean"] < 1.0
        assert {"ended_early", "iou", "collisions", "decision_ms"} <= entry.keys()
    assert "| **gain over distance (ours)** |" in (tmp_path / "results_explore.md").read_text()
    assert (tmp_path / "images" / "results_explore_mazes_coverage.png").stat().st_size > 0


def test_kinds_that_a_command_does_not_measure_stay(tmp_path: Path) -> None:
    kept = {
        "measured": {
            "command": "make results ARGS=before",
            "revision": "abc",
            "settings": {"split": "test", "scale": 0.5},
        }
    }
    kept |= {"images": {}, "places": 3, "poses": "true", "tables": {}, "paired": {}}
    (tmp_path / "explore.json").write_text(json.dumps({part: {"plans": value} for part, value in kept.items()}))
    folders = {"out": tmp_path, "docs": tmp_path, "runs": tmp_path / "runs"}
    main(Arguments(worlds=("mazes",), split="validation", count=2, rows=("ours",), most_s=2.0, **folders))
    result = json.loads((tmp_path / "explore.json").read_text())
    assert sorted(result["tables"]) == ["mazes", "plans"] and result["places"]["plans"] == 3
    page = (tmp_path / "results_explore.md").read_text()
    assert "make results ARGS=before" in page and "--worlds mazes" in page


def test_a_robot_that_estimates_its_poses_has_a_map_and_says_how_wrong_they_are(tmp_path: Path) -> None:
    folders = {"out": tmp_path, "docs": tmp_path, "runs": tmp_path / "runs"}
    chosen = {"worlds": ("slipping_wheels",), "own_rows": (), "split": "validation", "buildings": 2}
    main(Arguments(**chosen, scale=0.3, most_s=12.0, **folders))
    result = json.loads((tmp_path / "explore.json").read_text())
    assert list(result["tables"]["slipping_wheels"]) == ["explore_lite"]
    entry = result["tables"]["slipping_wheels"]["explore_lite"]
    command = result["measured"]["slipping_wheels"]["command"]
    assert all(part in command for part in (" --scale 0.3 ", " --most-s 12.0 ", " --split validation"))
    assert 0.0 < entry["ate_end_m"]["mean"] < 0.05 and entry["within"]["mean"] > 0.9
    assert entry["iou"]["mean"] > 0.1 and entry["path_m"]["mean"] > 0.1
    page = (tmp_path / "results_explore.md").read_text()
    assert "those of the lidar's estimators" in page
    assert "ATE at the end" in page and "ATE at 95 %" not in page  # nobody has seen as much


def test_a_tiny_maze_is_explored_to_its_end_with_and_without_its_map() -> None:
    config = ExplorerConfig(radius_m=TINY.radius_m)
    seen = Seen(*Maze(5, TINY).exact_scans())
    for run in (
        explore(Maze(5, TINY), seen, config, DriveConfig(), most_s=400.0, estimator=DriftsSteadily),
        drive_known_tour(Maze(5, TINY), seen, config, DriveConfig(), most_s=400.0),
    ):
        assert run.ended and run.coverage[-1] > 0.98 and run.collisions == 0
        assert (np.diff(run.path_m) >= 0.0).all() and 0.0 < run.path_to(0.95) <= run.path_m[-1]
        if run.errors:
            assert run.errors["ate_m"] == pytest.approx(run.time_s[run.coverage >= ENOUGH][0])
            assert run.errors["ate_m"] < run.errors["ate_end_m"]
