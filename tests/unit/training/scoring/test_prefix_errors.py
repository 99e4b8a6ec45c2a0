"""Errors on prefixes: each from its own frames alone."""

import numpy as np

from training.data.worlds import world_named
from training.scoring.prefix_errors import prefix_errors, stacked
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


def test_every_prefix_is_estimated_from_its_own_frames() -> None:
    counted = Counted()
    measured = prefix_errors(Estimator(counted, "one"), ARRAYS, (10, 5), WORLD)
    assert counted.seen == [5, 10, 20]
    for length in (5, 10, 20):
        expected = scores(TRUTH[:, :length] + [0.1 * length, 0.0, 0.0], TRUTH[:, :length], WORLD)
        for name, values in expected.items():
            np.testing.assert_allclose(stacked([measured, measured], length, name), [values, values])
    np.testing.assert_allclose(measured.drawn["poses"], TRUTH + [2.0, 0.0, 0.0], atol=1e-5)
