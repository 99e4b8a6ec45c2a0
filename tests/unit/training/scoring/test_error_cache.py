"""Errors on prefixes: each from its own frames alone, and never computed twice."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from training.data.worlds import world_named
from training.scoring.error_cache import evaluate_row
from training.scoring.row_estimators import Arrays, Estimator
from training.scoring.scores import scores

WORLD = world_named("maze2d")
TRUTH = np.cumsum(np.random.default_rng(0).normal(0.1, 0.05, (4, 20, 3)), axis=1)
ARRAYS: Arrays = {"relative": np.zeros_like(TRUTH, dtype=np.float32), "truth": TRUTH}


class Counted:
    """An estimator that is off by 0.1 m times the number of frames that it sees."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    def __call__(self, arrays: Arrays) -> np.ndarray:
        self.seen.append(arrays["relative"].shape[1])
        return np.asarray(arrays["truth"] + [0.1 * arrays["relative"].shape[1], 0.0, 0.0])


def run(poses: Callable[[Arrays], np.ndarray], cache: Path, identity: str = "one", data: str = "data") -> None:
    evaluate_row(Estimator(poses, identity), ARRAYS, data, (5, 10), WORLD, cache)


def test_every_prefix_is_estimated_from_its_own_frames(tmp_path: Path) -> None:
    counted = Counted()
    measured = evaluate_row(Estimator(counted, "one"), ARRAYS, "data", (10, 5), WORLD, tmp_path / "a.npz")
    assert counted.seen == [5, 10, 20]
    for length in (5, 10, 20):
        expected = scores(TRUTH[:, :length] + [0.1 * length, 0.0, 0.0], TRUTH[:, :length], WORLD)
        for name, values in measured.scores[length].items():
            np.testing.assert_allclose(values, expected[name])
    np.testing.assert_allclose(measured.poses, TRUTH + [2.0, 0.0, 0.0], atol=1e-5)


def test_what_is_known_is_read(tmp_path: Path) -> None:
    counted, cache = Counted(), tmp_path / "a.npz"
    first = evaluate_row(Estimator(counted, "one"), ARRAYS, "data", (5,), WORLD, cache)
    again = evaluate_row(Estimator(counted, "one"), ARRAYS, "data", (5,), WORLD, cache)
    assert counted.seen == [5, 20]
    np.testing.assert_array_equal(first.poses, again.poses)
    assert {length: set(found) for length, found in first.scores.items()} == {
        length: set(found) for length, found in again.scores.items()
    }
    for length, found in first.scores.items():
        for name, values in found.items():
            np.testing.assert_array_equal(values, again.scores[length][name])


@pytest.mark.parametrize("change", [{"identity": "other"}, {"data": "other"}])
def test_other_weights_or_other_data_are_estimated_anew(tmp_path: Path, change: dict[str, str]) -> None:
    counted, cache = Counted(), tmp_path / "a.npz"
    run(counted, cache)
    before = list(counted.seen)
    run(counted, cache, **change)
    assert counted.seen == before * 2


def test_other_code_is_run_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counted, cache = Counted(), tmp_path / "a.npz"
    run(counted, cache)
    monkeypatch.setattr("training.scoring.error_cache._code", lambda: "changed")
    run(counted, cache)
    assert counted.seen == [5, 10, 20] * 2


def test_an_estimate_that_fails_leaves_no_file(tmp_path: Path) -> None:
    def fail(_: Arrays) -> np.ndarray:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        run(fail, tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


def test_prefixes_beyond_the_trajectory_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected 1 to 20"):
        evaluate_row(Estimator(Counted(), "one"), ARRAYS, "data", (21,), WORLD, tmp_path / "a.npz")
