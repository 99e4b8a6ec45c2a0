"""A smoothed correction: continuous at the robot, and there in the end."""

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.slam.tf_smoothing import SmoothedCorrection

BASE = np.array([100.0, -40.0, 2.0])
BEFORE, AFTER = np.array([1.0, 2.0, 3.0]), np.array([2.0, 1.0, -3.0])  # half a degree beyond pi and back
PERIOD_NS = 50_000_000


def at_robot(map_from_odom: np.ndarray) -> np.ndarray:
    return se2.compose(torch.from_numpy(map_from_odom), torch.from_numpy(BASE)).numpy()


def test_without_a_time_constant_the_newest_value_passes() -> None:
    smoothed = SmoothedCorrection(0.0)
    for k, value in enumerate((BEFORE, AFTER)):
        np.testing.assert_array_equal(smoothed.update(k, value, BASE), value)


def test_the_gap_shrinks_by_e_in_a_time_constant_on_a_straight_line_at_the_robot() -> None:
    smoothed = SmoothedCorrection(1.0)
    start, end = at_robot(smoothed.update(0, BEFORE, BASE)), at_robot(AFTER)
    way = end - start
    way[2] = np.remainder(way[2] + np.pi, 2 * np.pi) - np.pi
    for k in range(1, 101):
        shown = at_robot(smoothed.update(k * PERIOD_NS, AFTER, BASE))
        share = 1.0 - np.exp(-k * PERIOD_NS * 1e-9)
        np.testing.assert_allclose(shown[:2], start[:2] + share * way[:2], atol=1e-9)
        turned = np.remainder(shown[2] - start[2] + np.pi, 2 * np.pi) - np.pi
        assert turned == pytest.approx(share * way[2])


def test_it_arrives_exactly_and_stays() -> None:
    smoothed = SmoothedCorrection(0.1)
    smoothed.update(0, BEFORE, BASE)
    np.testing.assert_allclose(smoothed.update(10**12, AFTER, BASE), AFTER, atol=1e-9)


def test_a_reset_and_a_stamp_that_stands_still() -> None:
    smoothed = SmoothedCorrection(1.0)
    smoothed.update(5, BEFORE, BASE)
    np.testing.assert_allclose(smoothed.update(5, AFTER, BASE), BEFORE, atol=1e-9)
    smoothed.reset()
    np.testing.assert_array_equal(smoothed.update(5, AFTER, BASE), AFTER)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_a_time_constant_that_cannot_be_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="expected 0 or more"):
        SmoothedCorrection(value)
