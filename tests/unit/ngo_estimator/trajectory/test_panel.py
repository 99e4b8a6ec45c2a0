"""Panels hold what they show, in metres of equal scale along both axes."""

import numpy as np
import pytest

from ngo_estimator.trajectory.panel import SIZE, Panel, nice_step


@pytest.mark.parametrize(
    ("extent_m", "step_m"), [(1.0, 0.2), (8.0, 1.0), (8.1, 2.0), (39.0, 5.0), (41.0, 10.0), (700.0, 100.0)]
)
def test_ticks_are_round_and_not_too_many(extent_m: float, step_m: float) -> None:
    assert nice_step(extent_m) == pytest.approx(step_m)


@pytest.mark.parametrize("box_m", [(30.0, 4.0), (0.1, 900.0), (0.0, 0.0)])
def test_all_that_is_shown_is_drawn_with_equal_scales(box_m: tuple[float, float]) -> None:
    corners = np.array([(-7.0, 3.0)]) + np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]) * box_m
    panel = Panel("a panel", [corners])
    empty = np.asarray(panel.picture())
    panel.cloud(corners)
    y, x = np.nonzero((np.asarray(panel.picture()) != empty).any(axis=-1))
    assert len(x) == len(np.unique(corners, axis=0)), "one pixel a point"
    width, height = np.ptp(x) + 1, np.ptp(y) + 1
    assert max(width, height) <= SIZE
    if max(box_m) > 1.0:
        assert width / max(width, height) == pytest.approx(box_m[0] / max(box_m), abs=0.01)
        assert height / max(width, height) == pytest.approx(box_m[1] / max(box_m), abs=0.01)


def test_points_that_lie_on_each_other_are_darker() -> None:
    apart, ends = np.array([(2.0, 0.0)]), np.array([(0.0, 0.0), (4.0, 1.0)])
    once, twice = Panel("", [ends]), Panel("", [ends])
    once.cloud(apart)
    twice.cloud(np.repeat(apart, 2, axis=0))
    assert np.asarray(twice.picture()).sum() < np.asarray(once.picture()).sum()
