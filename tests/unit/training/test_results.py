"""The JSON of the results, on errors that are known; and the mazes that figures show."""

import numpy as np
import pytest

from training.data.batches import seen_from_first
from training.data.episodes import GROUP, simulate
from training.data.worlds import world_named
from training.report import tables
from training.report.maze_views import in_maze, maze_and_start
from training.scoring.scores import METRICS
from training.scoring.table import Measured

WORLD = world_named("maze2d")
KEYS = [metric.key for metric in METRICS["maze2d"]]


def evaluation(errors: list[float]) -> Measured:
    values = np.array(errors)
    return Measured({f"{steps}:{key}": share * values for steps, share in ((4, 0.5), (8, 1.0)) for key in KEYS})


TABLE = {
    "local": [evaluation([1.0, 2.0, 3.0, 4.0])],
    "ngo_1": [evaluation([0.5, 1.0, 1.5, 2.0])] * 2,
    "ngo_5": [evaluation([0.1, 0.2, 0.3, 0.4]), evaluation([0.3, 0.4, 0.5, 0.6])],
    "gtsam": [evaluation([0.4, 0.6, 0.8, 1.0])],
}


def test_a_table_in_json() -> None:
    found = tables.table_json(TABLE, (4, 8), 8, WORLD)
    assert list(found) == list(TABLE)
    assert found["local"]["position_rmse"]["mean"] == pytest.approx(2.5)
    assert "seeds" not in found["local"]["position_rmse"]
    assert found["ngo_5"]["heading_rmse_deg"]["seeds"] == pytest.approx([0.25, 0.45])
    assert found["ngo_5"]["heading_rmse_deg"]["mean"] == pytest.approx(0.35)
    assert found["ngo_5"]["prefixes"]["4"]["position_rmse"]["mean"] == pytest.approx(0.175)
    assert found["ngo_5"]["prefixes"]["8"]["position_rmse"] == found["ngo_5"]["position_rmse"]


def test_rows_are_compared_where_both_are() -> None:
    found = tables.paired_json(TABLE, 8, WORLD)
    assert set(found) == {"ngo_1_vs_local", "ngo_5_vs_local", "gtsam_vs_local", "ngo_5_vs_ngo_1", "ngo_5_vs_gtsam"}
    assert found["ngo_5_vs_gtsam"]["position_rmse"]["relative_percent"]["mean"] == pytest.approx(-50.0)
    assert found["ngo_5_vs_gtsam"]["position_rmse"]["difference"]["mean"] == pytest.approx(-0.35)
    assert found["gtsam_vs_local"]["position_rmse"]["difference"]["ci95"][1] < 0.0


@pytest.mark.parametrize("index", [1, GROUP + 1])
def test_figures_show_the_maze_that_was_driven_through(index: int) -> None:
    seeds = WORLD.table_seeds("cycles", "validation")
    first = index // GROUP * GROUP
    episodes = list(simulate(WORLD, list(seeds[first : index + 1]), 60, WORLD.tables["cycles"].size))
    episode = episodes[index - first]
    maze, start = maze_and_start(WORLD, "cycles", "validation", index)
    np.testing.assert_array_equal(maze.walls, episode.maze.walls)
    np.testing.assert_allclose(start, episode.poses_xyyaw[0])
    placed = in_maze(start, seen_from_first(episode.poses_xyyaw)[1:])
    np.testing.assert_allclose(placed[:, :2], episode.poses_xyyaw[:, :2], atol=1e-9)
