"""The tables of the 3D world at toy size: seen and unseen mazes, and networks of their own."""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_estimator.checkpoint import write_untrained
from tests.smoke import toy
from training import (
    featurise,
    results,
    train_deepvo,
    train_end_to_end,
    train_local,
    train_optimizer,
    train_place,
    train_smoother,
    tune_pose_graph,
)
from training.common.records import RunError
from training.data.feature_store import open_store
from training.data.worlds import World, world_named
from training.report import figures
from training.report.maze_views import maze_and_start
from training.scoring.network_odometry import open_odometry
from training.scoring.table_rows import rows_of

pytestmark = pytest.mark.long

STEPS = 160
PREFIXES = (80, STEPS)
TABLES = ["seen", "unseen", "seen_policy", "unseen_policy"]
METRICS = (
    "translation_percent",
    "rotation_deg_per_m",
    "position_rmse_m",
    "heading_rmse_deg",
    "segment_translation_percent",
    "segment_rotation_deg_per_m",
)


def arguments(folder: Path) -> results.Arguments:
    return toy.results_of("maze3d", folder, trajectories=2, seeds=1, prefixes=PREFIXES)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("results")
    # That these are trained where they are missing is shown in 2D.
    write_untrained(folder / "weights" / "maze3d", "maze3d")
    (folder / "weights" / "maze3d" / "neural_graph_optimizer.safetensors").unlink()
    with pytest.MonkeyPatch.context() as patch:
        toy.shrink(patch, STEPS + 1, 300)
        toy.draw_coarsely(patch)
        mazes: dict[tuple[str, str, int], Any] = {}

        def drawn_once(world: World, table: str, split: str, index: int) -> Any:
            """Each maze needs an engine of its own."""
            if (table, split, index) not in mazes:
                mazes[table, split, index] = maze_and_start(world, table, split, index)
            return mazes[table, split, index]

        patch.setattr(figures, "maze_and_start", drawn_once)
        patch.setattr(tune_pose_graph, "GRID", tune_pose_graph.GRID[3:4])  # one group, as the unit tests try the rest
        yield folder, results.main(arguments(folder), toy.scripts("maze3d", folder))


def test_every_row_of_every_table_has_every_number(made: tuple[Path, dict[str, Any]]) -> None:
    folder, result = made
    assert json.loads((folder / "results" / "maze3d.json").read_text()) == result
    assert result["command"].startswith("python -m training.results --world maze3d ")
    assert (result["trajectories"], result["steps"], result["seeds"]) == (2, STEPS, [0])
    assert list(result["tables"]) == TABLES
    assert {"local", "local_no_action", "deepvo", "paper_1", "paper_5", "ngo_1", "ngo_5", "gauss_newton", "gtsam",
            "smoothed", "gtsam_smoothed",
            "end_to_end"} < set(rows_of(world_named("maze3d")))  # fmt: skip
    for table in result["tables"].values():
        assert list(table) == rows_of(world_named("maze3d"))
        for row in table.values():
            assert list(row["prefixes"]) == [str(length) for length in PREFIXES]
            for entry in (row, *row["prefixes"].values()):
                for metric in METRICS:
                    low, high = entry[metric]["ci95"]
                    assert 0.0 <= low <= entry[metric]["mean"] <= high
    assert {"odometry_smoother", "deepvo-seed0", "local_no_action-seed0", "ngo_5-seed0"} < set(result["trainings"])
    assert "--without-action" in result["trainings"]["local_no_action-seed0"]["command"]
    assert str(folder) not in json.dumps(result)


def test_networks_of_their_own_saw_the_same_trajectories(made: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = made
    for table in TABLES:
        shared = open_store(toy.sources("maze3d", folder).store_folder("validation", table))
        for row in ("local_no_action", "deepvo"):
            own = open_odometry(toy.sources("maze3d", folder).of_row(row, 0).store_folder("validation", table))
            np.testing.assert_array_equal(own["truth"], shared["truth"])
            assert not np.allclose(own["relative"], shared["relative"])
    driven = [open_store(toy.sources("maze3d", folder).store_folder("validation", table))["truth"] for table in TABLES]
    assert all(not np.allclose(a, b) for a, b in itertools.combinations(driven, 2))


def test_the_optimizer_learns_from_the_other_driver_and_the_smoother_does_not(
    made: tuple[Path, dict[str, Any]],
) -> None:
    folder, _ = made
    runs = folder / "runs" / "maze3d"
    ours, others = (open_store(runs / "features" / name)["truth"] for name in ("train", "train_policy"))
    assert len(ours) > len(others) >= 1
    learned_from = {
        kind: [json.loads(path.read_text())["settings"]["stores"] for path in runs.glob(f"{kind}-*/run.json")]
        for kind in ("smoother", "optimizer")
    }
    assert learned_from["smoother"] == [["train"]]
    of_optimizers = learned_from["optimizer"]
    assert of_optimizers and all(stores == ["train", "train_policy"] for stores in of_optimizers)


def test_nothing_is_made_twice(made: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    folder, result = made
    networks = (train_deepvo, train_end_to_end, train_local, train_optimizer, train_place, train_smoother)
    scripts = (*networks, featurise, tune_pose_graph)
    calls = ("training.prerequisites.make_odometry", "training.scoring.prefix_errors.scores")
    toy.refuse(monkeypatch, scripts, *calls)
    assert results.main(arguments(folder), toy.scripts("maze3d", folder)) == result


def test_odometry_of_another_network_is_not_mixed_in(made: tuple[Path, dict[str, Any]]) -> None:
    from training.scoring.network_odometry import make_odometry

    folder, _ = made
    store = toy.sources("maze3d", folder).of_row("deepvo", 0).store_folder("validation", "seen")
    kept = (store / "networks.json").read_text()
    try:
        (store / "networks.json").write_text('["another"]')
        with pytest.raises(RunError, match="made with another network"):
            make_odometry("deepvo", toy.sources("maze3d", folder), "validation", "seen", 2)
    finally:
        (store / "networks.json").write_text(kept)
