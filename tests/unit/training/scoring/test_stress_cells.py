import gzip
from pathlib import Path

import numpy as np
import pytest

from training.data.lidar_drives import Relations
from training.scoring import stress_cells
from training.scoring.lidar_rows import DriveRuns, Estimate, Row
from training.scoring.stress_cells import StressLog, cell_numbers, cell_of

S = 1_000_000_000
TAKEN = S * np.arange(1, 101)
POSES = np.stack((np.arange(100.0), np.zeros(100), np.zeros(100)), axis=-1)
RELATIONS = Relations(np.array([(1.0, 3.0), (1.0, 51.0), (10.01, 40.0), (20.5, 30.5)]), np.zeros((4, 3)))
WANTED = np.array([(2.0, 0.0, 0.0), (50.0, 0.0, 0.0), (29.0, 0.0, 0.1), (10.0, 0.0, 0.0)])
RELATIONS = Relations(RELATIONS.stamps_s, WANTED)


def test_numbers_are_means_over_the_relations_they_name() -> None:
    numbers = cell_numbers(RELATIONS, cell_of(TAKEN, POSES, TAKEN, 250.0), None)
    turn_deg = np.degrees(0.1)
    assert numbers["translation_m"] == pytest.approx(0.99 / 4)
    assert numbers["rotation_deg"] == pytest.approx(turn_deg / 4)
    assert numbers["over_30_s_m"] == pytest.approx(0.0, abs=1e-9)  # the second alone
    assert numbers["at_scans_m"] == pytest.approx(0.99 / 3)  # all but the last, which is between scans
    assert numbers["at_scans_deg"] == pytest.approx(turn_deg / 3)
    assert (numbers["relations"], numbers["scans_per_s"]) == (4, 250.0)
    assert "best_possible_m" not in numbers


def test_at_scans_counts_scans_that_were_kept() -> None:
    kept = np.isin(TAKEN, S * np.array([1, 2, 3, 60, 100]))
    cell = cell_of(TAKEN[kept], POSES[kept], TAKEN[kept])
    assert cell_numbers(RELATIONS, cell, None)["at_scans_m"] == pytest.approx(0.0, abs=1e-9)
    failed = cell_of(TAKEN[:0], POSES[:0], TAKEN, failed="no scan fits")
    assert "best_possible_m" not in cell_numbers(RELATIONS, cell, failed)
    none = cell_of(TAKEN[kept][3:], POSES[kept][3:], TAKEN[kept][3:])
    with pytest.raises(ValueError, match="none of 4 relations"):
        cell_numbers(RELATIONS, none, None)


def test_the_best_possible_is_the_clean_solution_between_the_scans_that_were_kept() -> None:
    bent = POSES.copy()
    bent[50, 1] = 3.0  # at 51 s, an end of the second relation
    cell = cell_of(TAKEN, POSES + (0.0, 9.0, 0.0), TAKEN)
    assert cell_numbers(RELATIONS, cell, cell_of(TAKEN, bent, TAKEN))["best_possible_m"] == pytest.approx(3.99 / 4)
    kept = np.arange(100) % 20 == 0  # the pose that is off is gone
    seen = cell_of(TAKEN[kept], POSES[kept], TAKEN[kept])
    assert cell_numbers(RELATIONS, seen, cell_of(TAKEN, bent, TAKEN))["best_possible_m"] < 0.34


def flaser(k: int) -> str:
    ranges = " ".join(f"{2.0 + 0.01 * ray:.2f}" for ray in range(180))
    pose = f"{0.1 * k:.2f} 0.0 0.0"
    return f"FLASER 180 {ranges} {pose} {pose} {100.0 + 0.2 * k:.3f} robot {0.2 * k:.3f}\n"


def write_log(folder: Path, scans: int = 1000) -> Path:
    """A robot that drives for 200 s, and one relation."""
    with gzip.open(folder / "straight.clf.gz", "wt") as stream:
        stream.write("".join(map(flaser, range(scans))))
    (folder / "straight.relations").write_text("110 130 10.0 0 0 0 0 0\n120 160 20.5 0 0 0 0 0\n")
    return folder / "straight.clf.gz"


def test_a_cell_is_measured_once_and_at_the_times_when_scans_were_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def estimate(runs: DriveRuns) -> Estimate:
        asked.append(runs.drive.name)
        stamps = runs.drive.scan_stamps_ns[5:]
        return Estimate(stamps, np.zeros((len(stamps), 3)), 100.0)

    def fails(runs: DriveRuns) -> Estimate:
        raise ValueError("no scan fits")

    rows = {"ours": Row(estimate, None, code=()), "kiss_icp": Row(fails, None, code=())}
    monkeypatch.setattr(stress_cells, "ROWS", rows)
    log = StressLog(write_log(tmp_path), tmp_path, tmp_path / "cache")
    assert log.cells("scans_bunched", 0, rows, known_only=True) == {}
    for _ in range(2):
        cells = log.cells("scans_bunched", 0, rows)
        drawn = cells["ours"].drawn
        np.testing.assert_array_equal(drawn["taken_ns"], drawn["kept_ns"][5:])
        np.testing.assert_allclose(np.diff(drawn["kept_ns"]) / S, 0.2, atol=1e-3)
        assert (cells["ours"].errors["scans_per_s"], cells["ours"].failed) == ([100.0], "")
        assert cells["kiss_icp"].failed == "no scan fits"
    assert asked == ["straight, scans_bunched, 0"]
    other = StressLog(tmp_path / "straight.clf.gz", tmp_path, tmp_path / "cache")
    assert other.cells("scans_bunched", 0, ["ours"], known_only=True)
    assert not other.cells("scans_bunched", 1, ["ours"], known_only=True)
    monkeypatch.setitem(rows, "ours", Row(estimate, {"other": 1}, code=()))
    assert not other.cells("scans_bunched", 0, ["ours"], known_only=True)


def test_rows_without_wheels_see_no_change_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def estimate(runs: DriveRuns) -> Estimate:
        asked.append(runs.drive.name)
        return Estimate(runs.drive.scan_stamps_ns, np.zeros((len(runs.drive.scans), 3)))

    rows = dict.fromkeys(("ours", "ours_without_wheels"), Row(estimate, None, code=()))
    monkeypatch.setattr(stress_cells, "ROWS", rows)
    log = StressLog(write_log(tmp_path), tmp_path, tmp_path / "cache")
    for change, seed in (("clean", 0), ("clean", 1), ("wheels_spin", 1)):
        assert list(log.cells(change, seed, rows)) == list(rows)
    assert asked == ["straight, clean, 0"] * 2 + ["straight, wheels_spin, 1"]
