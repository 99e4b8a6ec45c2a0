"""A year of patrols: its rows against answers by hand, and a short one in a real building."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_estimator.geometry import se2
from training import results_lifelong
from training.common.records import WEIGHTS
from training.scoring import year_rows
from training.scoring.metrics import rigid_motion
from training.scoring.table import Measured
from training.scoring.year_rows import Year, patrol


def test_the_motion_between_maps_is_found_again() -> None:
    motion = np.array((3.0, -1.0, 2.5))
    points = np.random.default_rng(1).normal(size=(20, 2))
    moved = se2.rotate(motion[2], points) + motion[:2]
    np.testing.assert_allclose(rigid_motion(points, moved), motion, atol=1e-12)


def a_year(drives: int) -> Measured:
    """Its drive number ``n`` has the error n, 2 n alone, needs n + 1 MB, and was not found at all where n is 5."""
    number = np.arange(float(drives))
    empty = {f"{when}_{kind}": np.zeros((2, 2), np.int8) for kind in ("found", "true") for when in _WHEN}
    corners = {f"{when}_corners": np.zeros((2, 2)) for when in _WHEN}
    error_m = np.where(number == 5.0, np.nan, number)
    errors = {"ate_m": error_m, "drive_ate_m": error_m, "alone_ate_m": 2.0 * error_m}
    errors |= {"memory_mb": number + 1.0, "ms_a_scan": number + 1.0}
    return Measured({**errors, "iou": 1.0 - 0.5 * (number == 7.0), "occupied_iou": 0.0 * number}, {**empty, **corners})


_WHEN = ("first", "middle", "last")


def test_the_table_has_ten_drives_a_row_and_keeps_what_is_not_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results_lifelong, "patrol", lambda year, identity: a_year(year.drives))
    folders: dict[str, Any] = {name: tmp_path / name for name in ("out", "docs", "runs")}
    folders["out"].mkdir()
    (folders["out"] / "lifelong.json").write_text('{"tables": {"other": {}}}')
    chosen = results_lifelong.Arguments(
        split="validation", tables=("year",), years=2, drives=30, year_rows=("learn", "keep_all"), **folders
    )
    result = results_lifelong.main(chosen)
    assert set(result["tables"]) == {"other", "year", "year_keep_all"}
    assert list(result["tables"]["year"]) == ["first_ten", "eleven_to_twenty", "last_ten"]
    means = [row["ate_m"]["mean"] for row in result["tables"]["year"].values()]
    assert means == pytest.approx([40.0 / 9.0, 14.5, 24.5])
    assert result["year"]["ratios"]["memory_mb"]["mean"] == pytest.approx(25.5 / 15.5)
    assert result["year"]["ratios"]["of_alone"]["mean"] == 0.5
    assert result["year"]["least"] == {"iou": 0.5}
    page = (tmp_path / "docs" / "results_lifelong.md").read_text()
    assert page.count("| last ten | 24.5 ") == 2 and "after any drive is 0.500." in page


def test_a_year_whose_last_drives_never_found_the_robot_has_no_ratio_of_errors() -> None:
    found, lost = a_year(30), a_year(30)
    for key in ("ate_m", "drive_ate_m", "alone_ate_m"):
        lost.errors[key][-10:] = np.nan
    both, one = (year_rows.year_ratios(years) for years in ([found, lost], [found]))
    assert all(both[key] == one[key] for key in ("ate_m", "drive_ate_m", "of_alone"))


def test_a_year_goes_on_from_what_is_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(year_rows, "MOST_SCANS", 100)
    year = Year(12_001, 1, 400, 1, 4000, WEIGHTS / "scan", tmp_path)
    first = patrol(year, "toy")
    longer = patrol(dataclasses.replace(year, drives=2), "toy")
    assert longer.errors["ate_m"][0] == first.errors["ate_m"][0] < 0.1
    # A map of one drive is that drive, and is laid on the truth as it is.
    assert first.errors["drive_ate_m"][0] == pytest.approx(first.errors["alone_ate_m"][0], rel=0.01)
    assert longer.errors["iou"][0] > 0.8
    assert longer.errors["nodes"][1] >= longer.errors["nodes"][0] > 20
    assert longer.drawn.keys() == a_year(2).drawn.keys()
    assert np.isnan(longer.errors["load_s"][0]) and longer.errors["load_s"][1] > 0.0
