"""The table of changed logs at toy size: a log that the simulator makes, the files, and runs that add to them."""

import gzip
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ngo_sim.building2d import Building2d
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from training import results_stress
from training.data import building_drives
from training.data.lidar_changes import CHANGES
from training.results_stress import Arguments
from training.scoring import stress_cells
from training.scoring.lidar_rows import ROWS

SCANNER = ScannerConfig(rays=180, field_of_view_deg=179.0, scan_period_s=0.5)
FIRST_S = 100.0


def write_log(folder: Path) -> None:
    """A CARMEN log of a drive through a small building, with relations of the truth."""
    drive = Building2d(FloorPlanConfig(scale=0.3), SCANNER).record(7, 60.0)
    with gzip.open(folder / "toy.clf.gz", "wt") as stream:
        for stamp_s, ranges, pose in zip(drive.stamps_s, drive.ranges_m, drive.wheel_poses_xyyaw, strict=True):
            numbers = " ".join(f"{value:.2f}" for value in np.minimum(ranges, 81.9))
            x, y, yaw = pose
            stream.write(f"FLASER 180 {numbers} {x:.4f} {y:.4f} {yaw:.5f} {x:.4f} {y:.4f} {yaw:.5f} ")
            stream.write(f"{FIRST_S + stamp_s:.3f} robot {stamp_s:.3f}\n")
    truth, lines = drive.true_poses_xyyaw, []
    for first in range(0, len(truth) - 100, 10):
        a, b = truth[first], truth[first + 10 * (1 + first % 90 // 10)]
        x, y = np.array([[np.cos(a[2]), np.sin(a[2])], [-np.sin(a[2]), np.cos(a[2])]]) @ (b - a)[:2]
        stamps = FIRST_S + drive.stamps_s[[first, first + 10 * (1 + first % 90 // 10)]]
        lines.append(f"{stamps[0]:.3f} {stamps[1]:.3f} {x:.4f} {y:.4f} 0 0 0 {b[2] - a[2]:.5f}")
    (folder / "toy.relations").write_text("\n".join(lines) + "\n")


@pytest.mark.timeout(600)
def test_results_of_a_toy_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(tmp_path)
    arguments = Arguments(
        logs=tmp_path,
        changes=("half_covered", "scans_bunched"),
        seeds=(0, 1),
        out=tmp_path / "out",
        docs=tmp_path / "docs",
        runs=tmp_path / "runs",
    )
    result = results_stress.main(arguments)
    text = (tmp_path / "out" / "stress.json").read_text()
    assert json.loads(text) == result
    assert str(tmp_path) not in text
    table = result["logs"]["toy"]
    there = {name for name in results_stress.STRESS_ROWS if not ROWS[name].missing()}
    assert all(set(table[change]) == there for change in ("clean", "half_covered", "scans_bunched"))
    assert set(table["wheels_spin"]) == there & set(stress_cells.BLIND_TO_WHEELS)  # as without a change
    assert "people" not in table
    ours = table["scans_bunched"]["ours"]
    numbers = {"translation_m", "rotation_deg", "over_30_s_m", "at_scans_m", "at_scans_deg"}
    assert numbers | {"best_possible_m", "best_possible_deg", "relations", "scans_per_s", "seeds"} == set(ours)
    assert set(ours["seeds"]) == {"0", "1"} and set(table["half_covered"]["ours"]["seeds"]) == {"0"}
    assert ours["translation_m"] == pytest.approx(np.mean([one["translation_m"] for one in ours["seeds"].values()]))
    assert 0.0 < table["clean"]["ours"]["translation_m"] < 0.1 < table["scans_bunched"]["wheels"]["translation_m"]
    assert ours["best_possible_m"] == table["clean"]["ours"]["translation_m"]
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == (2 + 1) * len(there)  # one of the changes is the same for every seed
    page = (tmp_path / "docs" / "results_stress.md").read_text()
    assert {bar["name"] for bar in result["bars"]} >= {"toy, half_covered, ours, translation_m"}
    assert "## Bars" in page and "## toy" in page and all(f"`{name}`" in page for name in CHANGES)

    def no_run(*_: object) -> None:
        raise AssertionError("a cell was measured again")

    monkeypatch.setattr(stress_cells, "DriveRuns", no_run)
    fewer = replace(arguments, changes=("half_covered",), rows=("ours",), logs_named=("toy",))
    assert results_stress.main(fewer)["logs"] == result["logs"]
    assert results_stress.main(replace(arguments, logs_named=("other",)))["logs"] == result["logs"]


@pytest.mark.timeout(600)
def test_simulated_tables_of_one_tiny_drive_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building_drives, "FloorPlanConfig", partial(FloorPlanConfig, scale=0.3))
    arguments = Arguments(
        tables=("buildings", "loops", "joins"),
        changes=("half_covered",),
        drives=1,
        length=0.04,
        split="validation",
        out=tmp_path / "out",
        docs=tmp_path / "docs",
        runs=tmp_path / "runs",
    )
    result = results_stress.main(arguments)
    assert json.loads((tmp_path / "out" / "stress.json").read_text()) == result
    tables = result["tables"]
    assert set(tables["buildings"]) == {"half_covered"}
    ours = tables["buildings"]["half_covered"]["ours"]
    assert ours["drives"] == 1 and 0.0 < ours["ate_m"] < 0.5 and 0.0 <= ours["within_three_deviations"] <= 1.0
    assert tables["loops"]["poor_wheels"]["wheels"]["largest_m"] > tables["loops"]["poor_wheels"]["ours"]["largest_m"]
    assert set(tables["joins"]) == {"aliased", "two_buildings", "same_building"}
    joins = tables["joins"]["two_buildings"]["ours"]
    assert joins["each"]["wrong_loops"] == [joins["wrong_loops"]]
    page = (tmp_path / "docs" / "results_stress.md").read_text()
    assert "## Wrong joins" in page and "## A car's loop" not in page
    again = results_stress.main(replace(arguments, tables=("joins",)))
    assert again["tables"] == tables


def test_names_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="changes has wheels_square; expected among clean"):
        Arguments(logs=tmp_path, changes=("wheels_square",))
    with pytest.raises(ValueError, match="rows has gtsam_lm"):
        Arguments(logs=tmp_path, rows=("gtsam_lm",))
    with pytest.raises(ValueError, match="the table of car needs --car"):
        Arguments(tables=("car",))
    with pytest.raises(ValueError, match="drives, length are 0"):
        Arguments(logs=tmp_path, drives=0)
    with pytest.raises(ValueError, match="no log with relations"):
        results_stress.main(Arguments(logs=tmp_path))
