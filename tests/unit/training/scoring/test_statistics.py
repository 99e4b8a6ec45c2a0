"""Bootstrap intervals against what is known of normal and paired samples."""

import numpy as np
import pytest

from training.scoring.statistics import compare, mean_interval


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
