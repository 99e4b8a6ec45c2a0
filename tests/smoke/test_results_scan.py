"""The lidar's results at toy size: every row, the files, and a second run that computes nothing."""

import json
import runpy
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from ngo_sim.floor_plans import FloorPlanConfig
from training import results, results_scan
from training.common import command_line
from training.data import building_drives
from training.scoring import lidar_rows
from training.scoring.lidar_rows import ROWS


@pytest.mark.timeout(600)
def test_results_of_two_tiny_buildings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building_drives, "FloorPlanConfig", partial(FloorPlanConfig, scale=0.3))
    arguments = results_scan.Arguments(
        buildings=2,
        ablation=2,
        length_m=4.0,
        mazes=2,
        frames=40,
        out=tmp_path / "out",
        docs=tmp_path / "docs",
        runs=tmp_path / "runs",
    )
    result = results_scan.main(arguments)
    text = (tmp_path / "out" / "scan.json").read_text()
    assert json.loads(text) == result
    assert str(tmp_path) not in text

    there = {name for name, row in ROWS.items() if not row.missing()}
    assert set(result["tables"]) == {"buildings", "aliased", "slip", "maze2d"}
    assert set(result["tables"]["buildings"]) == there
    assert set(result["tables"]["slip"]) == {"wheels", "ours"}
    without_wheels = {name for name in there if not ROWS[name].needs_wheels and not ROWS[name].ablation}
    assert set(result["tables"]["maze2d"]) == without_wheels
    ate = result["tables"]["buildings"]["ours"]["ate_m"]
    assert 0.0 < ate["mean"] < 0.3
    assert ate["drives"] == 2
    assert ate["ci95"][0] <= ate["mean"] <= ate["ci95"][1]
    assert result["paired"]["buildings"]["wheels"]["ate_m"]["relative_percent"]["mean"] > 0.0
    assert result["paired"]["aliased"]["gtsam_lm_30_percent_wrong"]["with"] == "ours_30_percent_wrong"
    assert result["paired"]["aliased"]["ours_30_percent_wrong"]["with"] == "ours_0_percent_wrong"
    assert result["logs"] == {}
    assert result["failed"] == []
    assert [line for line in result["skipped"] if line.startswith("logs: no folder")]

    page = (tmp_path / "docs" / "results_scan.md").read_text()
    assert "Simulated buildings" in page
    for image in ("results_scan_buildings.png", "results_scan_aliased.png"):
        assert image in page
        assert (tmp_path / "docs" / "images" / image).stat().st_size > 10_000

    def no_run(*_: object) -> None:
        raise AssertionError("a row was estimated again")

    monkeypatch.setattr(lidar_rows.DriveRuns, "__init__", no_run)
    again = results_scan.main(arguments)
    assert again["tables"] == result["tables"]

    for stored in (tmp_path / "runs" / "scan" / "results" / "buildings").glob("*_20001.*.npz"):
        stored.unlink()
    known = results_scan.main(replace(arguments, known=True))
    assert known["tables"]["buildings"]["ours"]["ate_m"]["drives"] == 1
    assert known["tables"]["aliased"] == result["tables"]["aliased"]

    shifted = results_scan.main(replace(arguments, known=True, first_building=1))
    assert shifted["settings"]["first_building"] == 1
    assert shifted["tables"]["buildings"] == known["tables"]["buildings"]  # what is published stays, and says so
    of = {"revision": known["revision"], "settings": known["settings"]}
    assert shifted["earlier"]["buildings"] == {**of, "measured": {}}
    page = (tmp_path / "docs" / "results_scan.md").read_text()
    assert "of an earlier revision: buildings" in page and "results_scan_buildings.png" in page
    assert shifted["tables"]["aliased"]["ours"]["ate_m"]["drives"] == 1


def test_rows_that_are_not_measured_anew_stay_but_for_those_with_wrong_loops() -> None:
    """Rows with wrong loops are compared with each other, so that all of them are of one revision."""
    old = {"revision": "1", "settings": {"ablation": 5}, "logs": {"aces": {"ours": {}}}, "failed": []}
    old |= {"tables": {"buildings": {"ours": {"ate_m": 1}, "ours_10_percent_wrong": {}}}, "paired": {}}
    result = {"logs": {}, "tables": {"buildings": {"ours_60_percent_wrong": {}, "wheels": {}}}, "failed": []}
    result |= {"revision": "2", "paired": {"logs": {}, "buildings": {}}}
    results_scan._keep_published(result, old)
    assert list(result["tables"]["buildings"]) == ["wheels", "ours", "ours_60_percent_wrong"]
    assert result["earlier"]["buildings"]["measured"] == {"ours_60_percent_wrong": "2", "wheels": "2"}
    assert result["logs"] == old["logs"]


@pytest.mark.parametrize("world", [("--world", "scan"), ("--world=scan",)])
def test_the_command_of_results_takes_the_lidar(
    world: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Run as a program within this process, which has imported everything already."""
    monkeypatch.setattr(sys, "argv", [results.__file__, *world, "--help"])
    monkeypatch.setattr(command_line, "quiet_framework", lambda: None)  # as it was for the other tests
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(results.__file__, run_name="__main__")
    shown = capsys.readouterr().out
    assert ended.value.code == 0
    assert "--logs" in shown
    assert "--prefixes" not in shown
