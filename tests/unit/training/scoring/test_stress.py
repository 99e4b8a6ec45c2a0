"""The stress tables: numbers of a cell, of simulated drives and of a car's loop, and the bars."""

import gzip
import math
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import all_between, compose
from training.data.lidar_drives import Relations
from training.results_stress import tables_with_earlier
from training.scoring import stress_cells
from training.scoring.lidar_rows import DriveRuns, Estimate, Row
from training.scoring.second_visit import second_visit
from training.scoring.stress_bars import stress_bars
from training.scoring.stress_cells import StressLog, cell_numbers, cell_of
from training.scoring.stress_rows import last_loop_error_m, wrong_joins

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


def test_cells_that_are_published_stay_until_they_are_measured_anew() -> None:
    published = {"aces": {"clean": {"ours": {"m": 2.0}, "kiss_icp": {"m": 3.0}}, "people": {"ours": {"m": 4.0}}}}
    measured = {"aces": {"clean": {"ours": {"m": 1.0}}}, "csail": {"clean": {"ours": {"m": 5.0}}}}
    found = tables_with_earlier(measured, published, "old")
    assert found["aces"]["clean"] == {"ours": {"m": 1.0}, "kiss_icp": {"revision": "old", "m": 3.0}}
    assert found["aces"]["people"] == {"ours": {"revision": "old", "m": 4.0}}
    assert found["csail"] == {"clean": {"ours": {"m": 5.0}}}
    assert tables_with_earlier({}, found, "new")["aces"]["clean"]["kiss_icp"]["revision"] == "old"


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
    monkeypatch.setattr(stress_cells, "_ROWS", rows)
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
    monkeypatch.setattr(stress_cells, "_ROWS", rows)
    log = StressLog(write_log(tmp_path), tmp_path, tmp_path / "cache")
    for change, seed in (("clean", 0), ("clean", 1), ("wheels_spin", 1)):
        assert list(log.cells(change, seed, rows)) == list(rows)
    assert asked == ["straight, clean, 0"] * 2 + ["straight, wheels_spin, 1"]


def out_and_back(way_m: float) -> np.ndarray:
    """Along x, around, and back, a pose each 0.25 m."""
    out = np.arange(0.0, way_m, 0.25)
    there = np.stack((out, np.zeros_like(out), np.zeros_like(out)), axis=-1)
    return np.concatenate((there, there[::-1] + (0.0, 0.2, math.pi)))


def test_the_last_loop_is_wrong_by_the_drift_since_the_first_visit() -> None:
    truth = out_and_back(60.0)
    assert last_loop_error_m(truth, truth) == pytest.approx(0.0, abs=1e-9)
    drifted = truth.copy()
    drifted[len(truth) // 2 :, 1] += 2.5
    assert last_loop_error_m(truth, drifted) == pytest.approx(2.5)
    drifted[:20] += (0.0, 2.5, 0.0)  # the start is off as well: only the visits of the last metres count
    assert last_loop_error_m(truth, drifted) == pytest.approx(0.0, abs=1e-9)


def test_without_a_loop_there_is_no_error() -> None:
    straight = out_and_back(60.0)[:240]
    assert math.isnan(last_loop_error_m(straight, straight))
    assert math.isnan(last_loop_error_m(out_and_back(20.0), out_and_back(20.0)))  # too little way between


def test_a_join_is_wrong_by_half_a_metre_or_five_degrees() -> None:
    truth = np.array([(0.0, 0.0, math.pi / 2), (0.0, 3.0, math.pi), (10_000.0, 0.0, 0.0)])
    pairs = np.array([(0, 1), (0, 1), (0, 1), (0, 2), (1, 0)])
    right = np.array((3.0, 0.0, math.pi / 2))
    relative = np.array([right, right + (0.4, 0.2, 0.05), right + (0.0, 0.6, 0.0), right, (0.0, 3.0, -1.4)])
    assert wrong_joins(truth, pairs, relative).tolist() == [False, False, True, True, True]
    relative[4, 2] = -math.pi / 2 + 2 * math.pi
    assert wrong_joins(truth, pairs, relative).tolist() == [False, False, True, True, False]


def numbers(metres: float, **more: float) -> dict[str, float]:
    return {"translation_m": metres, **more}


def test_bars_follow_from_the_error_without_a_change() -> None:
    rows = {
        "clean": {"wheels": numbers(1.0), "ours": numbers(0.1), "ours_without_wheels": numbers(0.2)},
        "scans_bunched": {"wheels": numbers(1.0), "ours": numbers(1.2), "ours_without_wheels": numbers(0.5)},
        "noise_5cm": {"ours": numbers(0.15)},
        "carried_while_paused": {"ours": numbers(3.0, at_scans_m=0.2)},
        "one_scan_in_ten": {"ours": numbers(0.5, best_possible_m=0.3)},
        "people": {"ours": {"failed": {"0": "no trajectory"}}, "kiss_icp": numbers(1.0)},
    }
    found = {bar.name: (bar.value, bar.most, bar.met) for bar in stress_bars({"log": rows})}
    expected = {
        "log, clean, ours beside wheels": (0.1, 1.05, True),
        "log, scans_bunched, ours, translation_m": (1.2, 0.13, False),
        "log, scans_bunched, ours_without_wheels, translation_m": (0.5, 2 * 0.26, True),
        "log, scans_bunched, ours beside wheels": (1.2, 1.05, False),
        "log, noise_5cm, ours, translation_m": (0.15, 0.16, True),
        "log, carried_while_paused, ours, at_scans_m": (0.2, 0.1, False),
        "log, one_scan_in_ten, ours, translation_m": (0.5, 0.6, True),
    }
    assert {name: (value, pytest.approx(most), met) for name, (value, most, met) in expected.items()} == found


WALLS = np.random.default_rng(0).uniform(-60.0, 60.0, (4000, 2))


def ring() -> np.ndarray:
    """Poses along a circle of 40 m radius, and 25 m of it once more."""
    angle = np.arange(0.0, 2.0 * math.pi + 25.0 / 40.0, 0.01)
    return np.stack((40.0 * np.sin(angle), 40.0 - 40.0 * np.cos(angle), angle), axis=-1)


def seen(poses: np.ndarray) -> list[np.ndarray]:
    """What lies within 20 m of each pose, in its frame."""
    points = np.pad(WALLS + (0.0, 40.0), ((0, 0), (0, 1)))
    frames = (all_between(pose[None], points)[:, :2] for pose in poses)
    return [near[np.hypot(*near.T) < 20.0] for near in frames]


@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (3.0, -4.0, 0.0), (-8.0, 0.5, math.radians(7.0))])
def test_a_second_visit_lies_where_it_was_put(motion: tuple[float, float, float]) -> None:
    poses = ring()
    last = slice(len(poses) - 51, None)  # poses are 0.4 m apart
    moved, middle = poses.copy(), np.array((*poses[last, :2].mean(axis=0), 0.0))
    moved[last] = [compose(middle, compose(np.array(motion), pose - middle)) for pose in poses[last]]
    found = second_visit(seen(poses), moved)
    assert found.metres == pytest.approx(math.hypot(*motion[:2]), abs=0.1)
    assert found.degrees == pytest.approx(math.degrees(motion[2]), abs=0.2)
    assert found.share > 0.9
    assert found.share_before > 0.9 if not any(motion) else found.share_before < 0.5
