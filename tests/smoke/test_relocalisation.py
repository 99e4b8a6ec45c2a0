"""The table of relocalisation at toy size: it is made, resumed, and read as it says."""

import json
from pathlib import Path

import pytest

from training import relocalisation
from training.data import kidnapped_drives
from training.data.kidnapped_drives import planned_drives
from training.data.worlds import WORLDS
from training.scoring import relocalisation_rows


def test_the_table_is_made_by_one_command_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kidnapped_drives, "STEPS", 450)
    arguments = relocalisation.Arguments(
        tables=("maze2d",), split="validation", mazes=2, starts=2, out=tmp_path, docs=tmp_path, runs=tmp_path
    )
    result = relocalisation.main(arguments)
    assert result == json.loads((tmp_path / "relocalisation.json").read_text())
    assert set(result["tables"]["maze2d"]) == set(relocalisation_rows.ROWS)
    for numbers in result["tables"]["maze2d"].values():
        assert {"mean", "ci95"} == set(numbers["success"]) and 0.0 <= numbers["false_claims"]["mean"] <= 1.0
    assert "## 2D mazes" in (tmp_path / "results_relocalisation.md").read_text()

    def never(*_: object) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr(relocalisation, "row_of", never)
    monkeypatch.setattr(relocalisation, "run_online", never)
    assert relocalisation.main(arguments)["tables"] == result["tables"]


def test_drives_in_a_maze_differ_and_no_other_table_has_their_mazes() -> None:
    world, taken = WORLDS["maze3d"], set()
    for split in ("validation", "test"):
        for aliased in (False, True):
            drives = planned_drives(world, split, aliased, 10)  # type: ignore[arg-type]
            mapped, second = drives["map"], drives["second"]
            assert mapped.mazes == second.mazes and mapped.size.aliased == aliased
            assert not {*mapped.seeds} & {*second.seeds} and mapped.driver != second.driver
            assert not taken & {*mapped.mazes, *second.seeds}
            taken |= {*mapped.mazes, *second.seeds}
    assert not taken & {
        seed for table in world.tables for split in ("validation", "test") for seed in world.table_seeds(table, split)
    }
