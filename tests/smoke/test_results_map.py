"""The table of the maps at toy size: every number is there, and true poses make the best maps."""

import json
from pathlib import Path

import pytest

from training.results_map import Arguments, main

pytestmark = pytest.mark.slow


def test_the_table_of_one_world(tmp_path: Path) -> None:
    folders = {"out": tmp_path, "docs": tmp_path, "runs": tmp_path / "runs"}
    main(Arguments(worlds=("maze2d",), split="validation", mazes=2, frames=40, **folders))
    result = json.loads((tmp_path / "map.json").read_text())
    table = result["tables"]["maze2d"]
    assert list(table) == ["odometry", "corrected", "true"]
    for entry in table.values():
        assert 0.0 <= entry["occupied_iou"]["ci95"][0] <= entry["occupied_iou"]["mean"] <= 1.0
    assert table["true"]["free_iou"]["mean"] > 0.8
    assert result["skipped"] == ["logs: no folder is given (--logs), or it has none"]
    page = (tmp_path / "results_map.md").read_text()
    assert "| `maze2d` | corrected |" in page
