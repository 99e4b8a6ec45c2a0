"""Bootstrap intervals against what is known of normal and paired samples."""

import numpy as np
import pytest

from training.scoring.statistics import Interval, compare, mean_interval


def test_the_interval_of_a_normal_sample_is_that_of_its_standard_error() -> None:
    values = np.random.default_rng(0).normal(5.0, 2.0, 400)
    error = values.std() / np.sqrt(len(values))
    interval = mean_interval(values)
    assert interval.mean == pytest.approx(values.mean())
    assert interval.low == pytest.approx(values.mean() - 1.96 * error, abs=0.05 * error)
    assert interval.high == pytest.approx(values.mean() + 1.96 * error, abs=0.05 * error)


def test_nineteen_of_twenty_intervals_hold_the_mean() -> None:
    rng = np.random.default_rng(1)
    intervals = [mean_interval(rng.normal(1.0, 1.0, 60)) for _ in range(300)]
    held = np.mean([interval.low < 1.0 < interval.high for interval in intervals])
    assert 0.91 < held < 0.98


def test_equal_values_have_no_interval() -> None:
    interval = mean_interval(np.full(10, 3.0))
    assert (interval.mean, interval.low, interval.high) == pytest.approx((3.0, 3.0, 3.0))


def test_seeds_are_averaged_before_trajectories_are_drawn() -> None:
    one = np.random.default_rng(2).uniform(1.0, 2.0, 50)
    # A seed that is worse by one everywhere moves the mean, and says nothing about how mazes differ.
    both = mean_interval(np.stack((one, one + 1.0)))
    alone = mean_interval(one)
    assert (both.mean, both.low, both.high) == pytest.approx((alone.mean + 0.5, alone.low + 0.5, alone.high + 0.5))


def test_intervals_are_the_same_every_time() -> None:
    values = np.random.default_rng(3).exponential(1.0, 30)
    assert mean_interval(values) == mean_interval(values.copy())


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


def test_an_estimator_does_not_differ_from_itself() -> None:
    values = np.random.default_rng(6).exponential(1.0, 40)
    comparison = compare(values, values)
    assert comparison.difference.low <= 0.0 <= comparison.difference.high
    assert comparison.relative_percent.mean == 0.0


def test_relative_differences_are_of_means_and_not_means_of_ratios() -> None:
    comparison = compare(np.array([1.0, 1.0]), np.array([1.0, 3.0]))
    assert comparison.relative_percent.mean == pytest.approx(-50.0)


def test_an_interval_as_json() -> None:
    assert Interval(1.0, 0.5, 2.0).as_json() == {"mean": 1.0, "ci95": [0.5, 2.0]}


@pytest.mark.parametrize(
    ("values", "message"),
    [(np.ones(1), "two or more"), (np.ones((2, 2, 2)), "expected"), (np.array([1.0, np.nan]), "finite")],
)
def test_what_has_no_interval_is_refused(values: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        mean_interval(values)


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(ValueError, match="2 and 3 trajectories"):
        compare(np.ones(2), np.ones(3))
    with pytest.raises(ValueError, match="positive"):
        compare(np.ones(3), np.zeros(3))
