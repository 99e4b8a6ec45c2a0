"""What a command of a table writes, and what it needs of it in its record."""

import json
from dataclasses import dataclass
from pathlib import Path

from training.common.records import record
from training.report.folders import Folders


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
