"""The search for the two best modes against a search of all poses."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.mode_search import Mixture, SearchWindow, two_modes
from ngo_estimator.geometry.planar_motion import transformed
from ngo_estimator.geometry.score_field import RayCounts, ScoreField, ScoreFieldConfig

CONFIG = ScoreFieldConfig(reach_m=6.0)


def seen(points: np.ndarray) -> ScoreField:
    counts = RayCounts(CONFIG, np.zeros(2))
    counts.add(np.zeros(2), points)
    return counts.field(points)


def walls(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed)
    along = np.linspace(-3.0, 3.0, 60)
    room = [np.stack((along, np.full(60, 2.0)), -1), np.stack((np.full(60, 3.0), along), -1)]
    return np.concatenate([*room, noise.uniform(-3.0, 3.0, (20, 2))])


def mixture(seed: int) -> Mixture:
    noise = np.random.default_rng(seed)
    means = noise.uniform(-0.4, 0.4, (3, 3))
    return Mixture(means, np.full((3, 2), 0.2), np.log(np.array((0.5, 0.3, 0.2))))


@pytest.mark.parametrize("seed", range(2))
def test_the_best_mode_is_that_of_all_poses(seed: int) -> None:
    field, points, prior = seen(walls(seed)), walls(seed + 100)[::3], mixture(seed)
    window = SearchWindow(np.array((0.1, -0.05, 0.2)), 0.6, math.radians(12.0), math.radians(2.0))
    best, total = two_modes(field, points, window, prior, 0.04, (0.3, 0.1), 3.0)[0]
    cell = CONFIG.cell_m
    totals = {}
    padded = np.pad(field.levels[0], 100, constant_values=round(255 * CONFIG.unknown))
    for turn in np.arange(-6, 7):
        # The search moves whole cells: points are rounded before they are moved.
        turned = transformed(window.centre + (0.0, 0.0, turn * math.radians(2.0)), points)
        cells = np.floor((turned - field.corner) / cell)
        for x in range(-10, 11):
            for y in range(-10, 11):
                pose = window.centre + (x * cell, y * cell, turn * math.radians(2.0))
                rows, columns = (cells[:, 1] + y).astype(int), (cells[:, 0] + x).astype(int)
                score = padded[rows + 100, columns + 100].mean() / 255.0
                totals[tuple(pose)] = score + 0.04 * prior.logs(pose).max()
    assert total == pytest.approx(max(totals.values()), abs=1e-9)
    np.testing.assert_allclose(best, max(totals, key=lambda pose: totals[pose]), atol=1e-9)


def test_two_places_that_look_alike_are_both_found() -> None:
    """A row of equal posts: half a metre on, all but one of them fit again."""
    posts = np.stack((np.arange(-3.0, 3.1, 0.5), np.full(13, 1.0)), -1)
    flat = Mixture(np.zeros((1, 3)), np.full((1, 2), 2.0), np.zeros(1))
    window = SearchWindow(np.zeros(3), 0.7, 0.05, 0.02)
    modes = two_modes(seen(posts), posts, window, flat, 0.04, (0.3, 0.1), 0.2)
    assert len(modes) == 2
    np.testing.assert_allclose(modes[0][0], 0.0, atol=0.04)
    assert abs(abs(modes[1][0][0]) - 0.5) < 0.07 and modes[1][1] < modes[0][1]


def test_what_other_scans_saw_through_is_no_wall() -> None:
    counts, wall, person = RayCounts(CONFIG, np.zeros(2)), np.array(((4.0, 0.0),)), np.array(((1.0, 0.0),))
    for _ in range(2):
        counts.add(np.zeros(2), wall)
    counts.add(np.zeros(2), person)
    assert counts.walls(np.concatenate((wall, person))).tolist() == [True, False]
    counts.forget_oldest()  # seen through by one, and hit by one
    assert counts.walls(person).tolist() == [True]


def test_a_widened_hypothesis_keeps_its_mass() -> None:
    """Ten times as wide in position and twice in heading: a density of a 200th at the mean, and others as before."""
    prior = mixture(0)
    wide = prior.widened(2.0, 0.4)
    np.testing.assert_allclose(wide.deviations[-1], (2.0, 0.4))
    assert wide.logs(prior.means[2])[2] == pytest.approx(prior.logs(prior.means[2])[2] - math.log(200.0))
    np.testing.assert_array_equal(wide.logs(prior.means[0])[:2], prior.logs(prior.means[0])[:2])
