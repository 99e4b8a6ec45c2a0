import pytest

from training.scoring.stress_bars import stress_bars


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
