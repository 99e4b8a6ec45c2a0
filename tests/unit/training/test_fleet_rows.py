"""When robots should have met, and whether they are where the common map has them, against answers by hand."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from training import results_lifelong
from training.data.lidar_drives import TruePoses
from training.scoring.fleet_rows import _Seen, _shared_since_ns
from training.scoring.table import Measured

SECOND_NS = 1_000_000_000


def way(x: np.ndarray, y: float) -> TruePoses:
    """A robot that is at these places one a second."""
    poses = np.column_stack((x, np.full(len(x), y), np.zeros(len(x))))
    return TruePoses(SECOND_NS * np.arange(len(x)), poses)


def test_robots_should_meet_once_they_had_ten_metres_in_common() -> None:
    first = way(np.arange(31.0), 0.0)
    behind = way(np.arange(31.0) - 8.0, 0.5)  # at 0 m after 8 s; there 10 m begin that the first one has driven
    for pair in ((first, behind), (behind, first)):
        assert _shared_since_ns(*pair) == pytest.approx(18 * SECOND_NS, abs=SECOND_NS)
    towards = way(30.0 - np.arange(31.0), 0.5)  # after 15 s they pass each other: each then sees where the other was
    assert _shared_since_ns(first, towards) == pytest.approx(20 * SECOND_NS, abs=SECOND_NS)
    assert _shared_since_ns(first, way(np.arange(31.0), 1.5)) is None


def test_a_robot_is_off_by_its_distance_beside_the_way_of_the_other() -> None:
    """The map is the world turned by a right angle and moved; the other robot is 3 m from where it should be."""
    red, blue = _Seen(None), _Seen(None)
    for x, y in ((0.0, 0.0), (4.0, 0.0), (4.0, 2.0)):
        red.take(np.array((5.0 - y, x, 0.0)), np.array((x, y, 0.0)))
    blue.take(np.array((5.0 - 7.0, 1.0, 0.0)), np.array((1.0, 7.0, 0.0)))
    assert red.off_m(blue) == pytest.approx(0.0, abs=1e-9)
    blue.take(np.array((5.0 - 7.0, 4.0, 0.0)), np.array((1.0, 7.0, 0.0)))
    assert red.off_m(blue) == pytest.approx(3.0)
    assert red.spread_m() == pytest.approx(np.sqrt(np.var((0, 4, 4)) + np.var((0, 0, 2))))


class Runs:
    """What two rows say of a building, without robots."""

    def __init__(self, error_m: float) -> None:
        self.error_m = error_m

    def alone(self) -> Measured:
        return Measured.of({"ate_m": self.error_m})

    def together(self) -> Measured:
        return Measured.of(
            {"ate_m": 0.5 * self.error_m, "joint_ate_m": self.error_m, "false_meetings": 0.0, "met": 1.0}
        )


@pytest.mark.parametrize(("name", "row"), [("fleet", "together"), ("join", "joined")])
def test_the_table_has_a_row_for_each_way_and_kind(
    name: Any, row: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results_lifelong, "_runs", lambda seed, aliased, arguments: Runs(0.1 + aliased))
    monkeypatch.setattr(
        results_lifelong, "_MEASURES", {"alone": lambda runs: runs.alone(), row: lambda runs: runs.together()}
    )
    folders = {name: tmp_path / name for name in ("out", "docs", "runs")}
    chosen = results_lifelong.Arguments(split="validation", tables=(name,), buildings=2, aliased=2, **folders)
    result = results_lifelong.main(chosen)
    how = result[name]
    assert how["command"].endswith(' --split validation"')
    assert list(result["tables"][name]) == ["alone", row, "aliased_alone", f"aliased_{row}"]
    assert result["tables"][name]["aliased_alone"]["ate_m"]["mean"] == pytest.approx(1.1)
    assert how["paired"][row]["ate_ratio"]["mean"] == pytest.approx(0.5)
    more = results_lifelong.main(dataclasses.replace(chosen, robots=4))
    assert more["tables"][f"{name}_4"] == result["tables"][name] == more["tables"][name]
    assert "--robots 4 " in more[f"{name}_4"]["command"] and more[name] == how
    page = (tmp_path / "docs" / "results_lifelong.md").read_text()
    assert page.count(f"| `{row}` | 0.0500 ") == 2 and "### 4 robots" in page
