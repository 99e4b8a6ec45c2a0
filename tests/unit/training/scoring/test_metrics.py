"""Errors of trajectories and their statistics, by hand."""

import dataclasses

import numpy as np
import pytest

from ngo_estimator.geometry import se2
from training.data.worlds import WORLDS, world_named
from training.scoring.metrics import trajectory_error
from training.scoring.prefix_errors import prefix_errors, stacked
from training.scoring.row_estimators import Arrays, Estimator
from training.scoring.scores import METRICS, scores
from training.scoring.statistics import compare, mean_interval

STRAIGHT = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0]])


def moved(poses: np.ndarray, x: float, y: float, yaw: float) -> np.ndarray:
    return se2.compose(np.array((x, y, yaw)), poses)


def test_errors_on_paper() -> None:
    estimate = STRAIGHT.copy()
    estimate[1:, 1] = [0.1, 0.2, 0.2]  # squares 0.01, 0.04, 0.04 over 4 frames: mean 0.0225
    estimate[1:, 2] = np.radians([1.0, -1.0, 2.0])  # squares 1, 1, 4: mean 1.5
    error = trajectory_error(estimate, STRAIGHT)
    assert error.position_rmse_m == pytest.approx(0.15)
    assert error.final_percent == pytest.approx(100.0 * 0.2 / 4.0)
    assert error.heading_rmse_deg == pytest.approx(np.sqrt(1.5))


def test_frames_of_reference_do_not_matter_but_nothing_else_is_aligned() -> None:
    rng = np.random.default_rng(0)
    estimate = STRAIGHT + rng.normal(0.0, 0.1, STRAIGHT.shape)
    plain = trajectory_error(estimate, STRAIGHT)
    other = trajectory_error(moved(estimate, 3.0, -2.0, 2.0), moved(STRAIGHT, -7.0, 1.0, -1.5))
    assert np.allclose(list(vars(other).values()), list(vars(plain).values()))
    # A heading that is wrong at the first frame turns all that follows: no alignment takes it away.
    turned = moved(STRAIGHT, 0.0, 0.0, 0.5)
    turned[0, 2] = 0.0
    assert trajectory_error(turned, STRAIGHT).final_percent == pytest.approx(100.0 * 2.0 * np.sin(0.25), rel=1e-6)


def test_heading_errors_are_wrapped() -> None:
    truth = STRAIGHT + [0.0, 0.0, np.pi - 0.01]
    truth[0, 2] = 0.0
    estimate = truth.copy()
    estimate[1:, 2] -= 2.0 * np.pi - 0.02
    error = trajectory_error(estimate, truth)
    assert error.heading_rmse_deg == pytest.approx(np.degrees(0.02) * np.sqrt(3 / 4))


def test_nineteen_of_twenty_intervals_hold_the_mean() -> None:
    rng = np.random.default_rng(1)
    intervals = [mean_interval(rng.normal(1.0, 1.0, 60)) for _ in range(300)]
    held = np.mean([interval.low < 1.0 < interval.high for interval in intervals])
    assert 0.91 < held < 0.98


def test_seeds_are_averaged_before_trajectories_are_drawn() -> None:
    one = np.random.default_rng(2).uniform(1.0, 2.0, 50)
    # A seed that is worse by one everywhere moves the mean, and says nothing about how mazes differ.
    both = mean_interval(np.stack((one, one + 1.0)))
    alone = mean_interval(one)
    assert (both.mean, both.low, both.high) == pytest.approx((alone.mean + 0.5, alone.low + 0.5, alone.high + 0.5))


def test_a_pair_shares_its_mazes() -> None:
    rng = np.random.default_rng(4)
    others = rng.exponential(5.0, 100)  # mazes differ far more than the estimators do
    values = others - 0.1 + rng.normal(0.0, 0.01, 100)
    comparison = compare(values, others)
    assert comparison.difference.mean == pytest.approx(-0.1, abs=0.01)
    assert comparison.difference.high - comparison.difference.low < 0.01
    assert comparison.difference.high < 0.0
    assert mean_interval(values).high > mean_interval(others).low  # unpaired, nothing could be said


def test_a_constant_ratio_is_exact() -> None:
    others = np.random.default_rng(5).exponential(1.0, 40)
    relative = compare(0.3 * others, others).relative_percent
    assert (relative.mean, relative.low, relative.high) == pytest.approx((-70.0, -70.0, -70.0))


def test_relative_differences_are_of_means_and_not_means_of_ratios() -> None:
    comparison = compare(np.array([1.0, 1.0]), np.array([1.0, 3.0]))
    assert comparison.relative_percent.mean == pytest.approx(-50.0)


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


def test_the_metrics_of_the_2d_world() -> None:
    truth = np.zeros((1, 3, 3))
    truth[0, :, 0] = [1.0, 2.0, 4.0]
    estimate = truth + [0.0, 0.0, 2.0 * np.pi]  # a whole turn is no error
    estimate[0, :, 1] = [0.1, 0.2, 0.2]  # squares 0.01, 0.04, 0.04 over 4 frames: mean 0.0225
    found = scores(estimate, truth, dataclasses.replace(WORLD, block_m=0.5))
    assert {name: float(value[0]) for name, value in found.items()} == pytest.approx(
        {"position_rmse": 0.3, "position_percent": 3.75, "final_percent": 5.0, "heading_rmse_deg": 0.0}, abs=1e-9
    )
    with pytest.raises(ValueError, match="1 and 2 trajectories"):
        scores(estimate, np.concatenate((truth, truth)), WORLD)


def test_the_metrics_of_the_3d_world() -> None:
    truth = np.zeros((1, 2, 3))
    truth[0, :, 0] = [2.0, 8.0]
    estimate = truth.copy()
    estimate[0, :, 1] = [0.3, 0.4]
    estimate[0, :, 2] = [0.0, -np.radians(8.0)]
    found = scores(estimate, truth, world_named("maze3d"))
    assert found["translation_percent"] == pytest.approx([5.0])
    assert found["rotation_deg_per_m"] == pytest.approx([1.0])
    assert found["position_rmse_m"] == pytest.approx([np.sqrt(0.25 / 3.0)])


def test_segment_errors_of_the_3d_world() -> None:
    """A scale of 1.1 and a turn of 0.1 deg a metre along a straight line, over segments of the lengths that fit."""
    along = np.arange(0.5, 12.5, 0.5)
    truth = np.stack((along, np.zeros_like(along), np.zeros_like(along)), axis=-1)[None]
    estimate = truth * 1.1
    estimate[..., 2] = np.radians(0.1) * along
    found = scores(estimate, truth, world_named("maze3d"))
    # The first frame beyond a length is half a metre farther on; segments start at 0 and 5 m (of 5 m), 0 m (of 10 m).
    ends = {5.0: 5.5, 10.0: 10.5}
    turns = [0.1 * ends[5.0] / 5.0] * 2 + [0.1 * ends[10.0] / 10.0]
    assert found["segment_rotation_deg_per_m"] == pytest.approx([np.mean(turns)])
    moved = [
        _shifted(1.1 * ends[m], np.radians(0.1 * start), ends[m]) / m for start, m in ((0, 5.0), (5, 5.0), (0, 10.0))
    ]
    assert found["segment_translation_percent"] == pytest.approx([100.0 * np.mean(moved)])


def _shifted(length: float, turn: float, true_length: float) -> float:
    """How far a motion ahead is off that is seen from a pose that is turned."""
    return float(np.hypot(length * np.cos(turn) - true_length, length * np.sin(turn)))


def test_every_world_has_metrics() -> None:
    assert set(METRICS) == set(WORLDS)
