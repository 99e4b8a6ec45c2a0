"""The tables of results at toy size: from nothing to JSON, page and figures."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from tests.smoke import toy
from training import results, tune_pose_graph
from training.data import worlds
from training.data.feature_store import open_store
from training.data.worlds import MazeSize, Table, world_named
from training.scoring.metrics import trajectory_error
from training.scoring.table_rows import ROWS, rows_of

STEPS = 160
PREFIXES = (40, 77, STEPS)


def arguments(folder: Path) -> results.Arguments:
    return toy.results_of("maze2d", folder, trajectories=3, seeds=2, prefixes=PREFIXES)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as patch:
        toy.shrink(patch, STEPS + 1, 300)
        toy.draw_coarsely(patch)
        patch.setattr(tune_pose_graph, "GRID", tune_pose_graph.GRID[3:4])  # one group, as the unit tests try the rest
        tables = {"perfect": Table(MazeSize(2, 0)), "cycles": Table(MazeSize(2, 1), stretch=1)}
        world = dataclasses.replace(worlds.WORLDS["maze2d"], tables=tables)
        patch.setitem(worlds.WORLDS, "maze2d", world)
        yield folder, results.main(arguments(folder), toy.scripts("maze2d", folder))


def test_every_row_has_every_number(made: tuple[Path, dict[str, Any]]) -> None:
    folder, result = made
    assert json.loads((folder / "results" / "maze2d.json").read_text()) == result
    assert result["command"].startswith("python -m training.results --world maze2d ")
    assert (result["trajectories"], result["steps"], result["seeds"]) == (3, STEPS, [0, 1])
    assert list(result["tables"]) == ["perfect", "cycles"]
    for table in result["tables"].values():
        assert list(table) == rows_of(world_named("maze2d"))
        for name, row in table.items():
            for entry in (row, *row["prefixes"].values()):
                for metric in ("position_rmse", "position_percent", "heading_rmse_deg"):
                    low, high = entry[metric]["ci95"]
                    assert 0.0 <= low <= entry[metric]["mean"] <= high
                    if ROWS[name].form is not None:
                        assert np.mean(entry[metric]["seeds"]) == pytest.approx(entry[metric]["mean"])
            assert list(row["prefixes"]) == [str(length) for length in PREFIXES]
            # A prefix as long as the trajectory is the trajectory.
            assert row["prefixes"][str(STEPS)]["position_rmse"] == row["position_rmse"]
    assert "ngo_5_vs_gtsam" in result["paired"]["cycles"]
    assert str(folder) not in json.dumps(result)


def test_the_odometrys_row_is_the_mean_of_its_trajectories(made: tuple[Path, dict[str, Any]]) -> None:
    folder, result = made
    sources = toy.sources("maze2d", folder)
    store = open_store(sources.store_folder("validation", "cycles"))
    errors = []
    for relative, truth in zip(store["relative"][:3].astype(np.float64), store["truth"][:3], strict=True):
        poses = np.zeros((STEPS + 1, 3))
        for k, (x, y, yaw) in enumerate(relative):
            cos, sin = np.cos(poses[k, 2]), np.sin(poses[k, 2])
            poses[k + 1] = poses[k] + [cos * x - sin * y, sin * x + cos * y, yaw]
        errors.append(trajectory_error(poses, np.concatenate((np.zeros((1, 3)), truth))))
    row = result["tables"]["cycles"]["local"]
    assert row["position_rmse"]["mean"] == pytest.approx(np.mean([error.position_rmse_m for error in errors]))
    assert row["heading_rmse_deg"]["mean"] == pytest.approx(np.mean([error.heading_rmse_deg for error in errors]))


def test_the_page_shows_the_tables_and_every_figure(made: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = made
    page = (folder / "docs" / "results_maze2d.md").read_text()
    for name in ("perfect", "cycles"):
        assert f"## Table `{name}`" in page
    for row in rows_of(world_named("maze2d")):
        assert page.count(f"| `{row}` |") >= 4  # whole trajectories and prefixes of two tables
    images = sorted((folder / "docs" / "images").iterdir())
    assert [image.name.removeprefix("results_maze2d_") for image in images] == [
        "error_by_frames.png",
        "learning_curves.png",
        "percent_by_distance.png",
        "trajectories.png",
    ]
    for image in images:
        assert f"(images/{image.name})" in page
        assert matplotlib.image.imread(image).std() > 0.01


def test_estimates_of_other_weights_are_not_taken_for_these(made: tuple[Path, dict[str, Any]]) -> None:
    folder, result = made
    sources = toy.sources("maze2d", folder)
    rows = folder / "runs" / "maze2d" / "rows"
    old, new = rows / "ngo_5-seed0", rows / "ngo_5-seed1"
    kept = {path.name: path.read_bytes() for path in old.iterdir()}
    try:
        for path in new.iterdir():
            (old / path.name).write_bytes(path.read_bytes())
        found = results.evaluate_rows(arguments(folder), sources, "cycles")["ngo_5"]
    finally:
        for name, content in kept.items():
            (old / name).write_bytes(content)
    before = result["tables"]["cycles"]["ngo_5"]["position_rmse"]["seeds"]
    assert [np.mean(one.errors[f"{STEPS}:position_rmse"]) for one in found] == [before[1], before[1]]
    assert before[0] != before[1]


def test_weights_that_were_trained_on_other_networks_are_refused(made: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = made
    path = folder / "runs" / "maze2d" / "rows" / "ngo_1-seed0" / "neural_graph_optimizer.json"
    kept = path.read_text()
    try:
        path.write_text(json.dumps({**json.loads(kept), "place_encoder_sha256": "another"}))
        with pytest.raises(ValueError, match=r"ngo_1-seed0 was trained on features of other networks"):
            results.main(arguments(folder), toy.scripts("maze2d", folder))
    finally:
        path.write_text(kept)
