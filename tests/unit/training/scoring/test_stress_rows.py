import math

import numpy as np
import pytest

from training.scoring.stress_rows import last_loop_error_m, wrong_joins


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
