"""Small tables on Doom maps and of maps."""

import dataclasses
import json
from pathlib import Path

import pytest

from ngo_estimator.checkpoint import OPTIMIZER, load_place, save_checkpoint, write_untrained
from training import results_doom, results_map, train_loop_judge, tune_doom
from training.scoring.doom_rows import METRICS, ROWS

pytestmark = pytest.mark.slow


def test_choices_and_table_with_little(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_untrained(tmp_path / "weights" / "doom", "doom")
    monkeypatch.setitem(results_doom._MAPS, "test", (("take_cover.wad", "MAP01"),))
    monkeypatch.setattr(results_doom, "draw_levels", lambda path: None)
    monkeypatch.setattr(tune_doom, "VALIDATION_MAPS", (("simpler_basic.wad", "MAP01"),))
    for name in ("DRIFTS", "BELIEFS", "STEP_SCALES", "LOOP_SCALES"):
        monkeypatch.setattr(tune_doom, name, getattr(tune_doom, name)[:1])
    monkeypatch.setattr(tune_doom, "FEWER", 1)
    # Networks that learned nothing see no ranges.
    search = dataclasses.replace(train_loop_judge.SEARCH, registrations=0, overlaps=0)
    monkeypatch.setattr(train_loop_judge, "SEARCH", search)
    folders = {"weights": tmp_path / "weights", "runs": tmp_path / "runs", "out": tmp_path / "out"}
    folders["out"].mkdir()
    folder = folders["weights"] / "doom"
    details = {"place_encoder_sha256": load_place(folder, "doom")[1]["sha256"]}
    judging = train_loop_judge.untrained(folder)
    save_checkpoint(folder / f"{OPTIMIZER}.safetensors", judging, OPTIMIZER, "doom", details)
    tune_doom.main(tune_doom.Arguments(seeds=1, frames=120, **folders))
    result = results_doom.main(results_doom.Arguments(seeds=2, frames=120, docs=tmp_path / "docs", **folders))
    assert json.loads((tmp_path / "out" / "doom.json").read_text()) == result
    (entry,) = result["maps"].values()
    assert all(set(entry[row]) == set(METRICS) for row in ROWS)
    assert set(entry["ours"]["ate_m"]) == {"mean", "ci95"} and 0.0 <= entry["ours"]["within_3_std"]["mean"] <= 1.0
    page = (tmp_path / "docs" / "results_doom.md").read_text()
    assert "take_cover" in page and all(f"`{row}`" in page for row in ROWS)
    assert (tmp_path / "docs" / "images" / "results_doom_maps.png").stat().st_size > 1000


def test_the_table_of_one_world(tmp_path: Path) -> None:
    folders = {"out": tmp_path, "docs": tmp_path, "runs": tmp_path / "runs"}
    results_map.main(results_map.Arguments(worlds=("maze2d",), split="validation", mazes=2, frames=40, **folders))
    result = json.loads((tmp_path / "map.json").read_text())
    table = result["tables"]["maze2d"]
    assert list(table) == ["odometry", "corrected", "true"]
    for entry in table.values():
        assert 0.0 <= entry["occupied_iou"]["ci95"][0] <= entry["occupied_iou"]["mean"] <= 1.0
    assert table["true"]["free_iou"]["mean"] > 0.8
    page = (tmp_path / "results_map.md").read_text()
    assert "| `maze2d` | corrected |" in page
