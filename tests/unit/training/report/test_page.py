"""Pages and folders of results."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from training.common.records import ROOT, WEIGHTS, record
from training.data.worlds import world_named
from training.report import doom_page, faults_page, lidar_page, map_page, relocalisation_page, results_page
from training.report.folders import Folders
from training.report.page import Column, number, short, table

Page = Callable[[dict[str, Any], dict[str, str]], str]
PAGES: dict[str, Page] = {
    "maze2d": lambda result, images: results_page.page(result, images, world_named("maze2d")),
    "maze3d": lambda result, images: results_page.page(result, images, world_named("maze3d")),
    "scan": lidar_page.page,
    "doom": lambda result, _: doom_page.page(result, WEIGHTS / "doom"),
    "faults": lambda result, _: faults_page.page(result),
    "map": lambda result, _: map_page.page(result),
    "relocalisation": lambda result, _: relocalisation_page.page(result),
}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_in_the_docs_is_what_its_json_says(name: str) -> None:
    result = json.loads((ROOT / "training" / "results" / f"{name}.json").read_text())
    text = (ROOT / "docs" / f"results_{name}.md").read_text()
    images = {file: caption for caption, file in re.findall(r"!\[([^\]]*)\]\(images/([^)]+)\)", text)}
    assert PAGES[name](result, images) == text


NUMBERS = {"mean": 0.02, "ci95": [0.01, 1.5]}


def test_a_table_has_a_line_a_row_and_an_empty_cell_for_no_number() -> None:
    shown = (Column("share", "Share, %", short, 100.0), Column("m", "Error, m", number))
    rows = {
        "ours": {"share": NUMBERS, "m": {"mean": 12.345, "ci95": None}},
        "other": {"m": {"mean": None, "ci95": None}},
    }
    assert table(rows, shown, "Row").splitlines() == [
        "| Row | Share, % | Error, m |",
        "| --- | --- | --- |",
        "| ours | 2 [1, 150] | 12.3 |",
        "| other |  |  |",
    ]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (123.4, "123"),
        (12.34, "12.3"),
        (1.234, "1.23"),
        (0.1234, "0.123"),
        (0.01234, "0.0123"),
        (-0.5, "-0.500"),
        (0.0, "0.000"),
    ],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


@dataclass(frozen=True)
class Arguments(Folders):
    drives: int = 3  # Drives.


def test_json_and_page_lie_in_the_folders_for_them_and_no_folder_is_recorded(tmp_path: Path) -> None:
    arguments = Arguments(drives=4, out=tmp_path / "out", docs=tmp_path / "docs")
    assert arguments.publish("rooms", {"a": [1, 2]}, "# Rooms\n") == {"a": [1, 2]}
    assert json.loads((tmp_path / "out" / "rooms.json").read_text()) == {"a": [1, 2]}
    assert (tmp_path / "docs" / "results_rooms.md").read_text() == "# Rooms\n"
    assert arguments.images == tmp_path / "docs" / "images"
    assert record("rooms", arguments)["command"] == "python -m training.rooms --drives 4"
