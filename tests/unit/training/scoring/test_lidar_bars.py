import numpy as np

from training.scoring.lidar_bars import Bar, bars
from training.scoring.table import Measured


def scored(**errors: float | list[float]) -> Measured:
    return Measured({name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in errors.items()})


def by_name(found: list[Bar]) -> dict[str, Bar]:
    return {bar.name: bar for bar in found}


def test_a_log_is_held_against_its_bars_by_the_mean_of_its_relations() -> None:
    errors = scored(translation_m=[0.02, 0.05], rotation_deg=[0.3], far_m=[0.2], odometry_translation_m=[0.1])
    found = by_name(bars({"logs": {"aces": {"ours": errors}}}, {}))
    assert (found["aces, ours: translation_m"].value, found["aces, ours: translation_m"].met) == (0.035, True)
    assert not found["aces, ours: far_m"].met


def test_harm_names_the_worst_drive() -> None:
    table = {
        "good": {"ours": scored(ate_m=0.1, odometry_ate_m=1.0)},
        "bad": {"ours": scored(ate_m=1.1, odometry_ate_m=1.0)},
    }
    (harm,) = [bar for bar in bars({"buildings": table}, {}) if "corrected by odometry" in bar.name]
    assert "bad, ours" in harm.name
    assert not harm.met
    assert by_name(bars({"buildings": table}, {}))["worst ate_m of 2 buildings"].value == 1.1


def test_the_covariance_must_hold_the_truth_often_enough() -> None:
    table = {str(k): {"ours": scored(ate_m=0.1, odometry_ate_m=0.1, within_three_deviations=k)} for k in (0.9, 1.0)}
    (bar,) = [bar for bar in bars({"buildings": table}, {}) if "three deviations" in bar.name]
    assert (bar.value, bar.met) == (0.95, True)


def test_logs_of_a_mapper_are_held_against_their_wheels_each() -> None:
    logs = {
        "a": {"ours": scored(ate_m=0.1, odometry_ate_m=0.5), "wheels": scored(ate_m=2.0)},
        "b": {"ours": scored(ate_m=0.4, odometry_ate_m=0.5), "wheels": scored(ate_m=0.3)},
    }
    found = by_name(bars({"logs": logs}, {}))
    assert found["median ate_m of 2 logs with a mapper's poses"].value == 0.25
    assert found["a: ate_m, at most that of raw odometry"].met
    assert not found["b: ate_m, at most that of raw odometry"].met
