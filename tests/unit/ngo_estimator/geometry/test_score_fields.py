"""Fields of scores over poses: their modes, and what they say along a corridor."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.mode_search import Mixture, two_modes
from ngo_estimator.geometry.planar_motion import inverted, transformed
from ngo_estimator.geometry.scan_matching import Registration
from ngo_estimator.geometry.score_field import RayCounts, ScoreField, ScoreFieldConfig
from ngo_estimator.geometry.score_profile import held_along

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
    window = np.array((0.1, -0.05, 0.2)), (0.6, math.radians(12.0)), math.radians(2.0)
    best, total = two_modes(field, points, *window, prior=prior, weight=0.04, apart=(0.3, 0.1), margin=3.0)[0]
    cell = CONFIG.cell_m
    totals = {}
    padded = np.pad(field.levels[0], 100, constant_values=round(255 * CONFIG.unknown))
    for turn in np.arange(-6, 7):
        # The search moves whole cells: points are rounded before they are moved.
        turned = transformed(window[0] + (0.0, 0.0, turn * math.radians(2.0)), points)
        cells = np.floor((turned - field.corner) / cell)
        for x in range(-10, 11):
            for y in range(-10, 11):
                pose = window[0] + (x * cell, y * cell, turn * math.radians(2.0))
                rows, columns = (cells[:, 1] + y).astype(int), (cells[:, 0] + x).astype(int)
                score = padded[rows + 100, columns + 100].mean() / 255.0
                totals[tuple(pose)] = score + 0.04 * prior.logs(pose).max()
    assert total == pytest.approx(max(totals.values()), abs=1e-9)
    np.testing.assert_allclose(best, max(totals, key=lambda pose: totals[pose]), atol=1e-9)


def test_two_places_that_look_alike_are_both_found() -> None:
    """A row of equal posts: half a metre on, all but one of them fit again."""
    posts = np.stack((np.arange(-3.0, 3.1, 0.5), np.full(13, 1.0)), -1)
    flat = Mixture(np.zeros((1, 3)), np.full((1, 2), 2.0), np.zeros(1))
    window = np.zeros(3), (0.7, 0.05), 0.02
    modes = two_modes(seen(posts), posts, *window, prior=flat, weight=0.04, apart=(0.3, 0.1), margin=0.2)
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
    wide, alone = prior.widened(2.0, 0.4), prior.widened(2.0, 0.4, alone=True)
    np.testing.assert_allclose(wide.deviations[-1], (2.0, 0.4))
    assert wide.logs(prior.means[2])[2] == pytest.approx(prior.logs(prior.means[2])[2] - math.log(200.0))
    np.testing.assert_array_equal(wide.logs(prior.means[0])[:2], prior.logs(prior.means[0])[:2])
    np.testing.assert_array_equal(alone.logs(prior.means[0]), wide.logs(prior.means[0])[2:])


SETTINGS = {"unknown": 0.97, "noise": 0.5, "weight": 0.025}


def corridor(doors: bool, half_m: float = 4.0) -> np.ndarray:
    """Two walls along x, one with two recesses of 0.4 m and their sides, where it has ``doors``."""
    along = np.arange(-half_m, half_m, 0.05)
    recessed = (np.abs(along - 0.8) < 0.4) | (np.abs(along + 0.9) < 0.3)
    upper = np.stack((along, 1.0 + np.where(doors & recessed, 0.4, 0.0)), -1)
    sides = [np.stack((np.full(9, x), np.linspace(1.0, 1.4, 9)), -1) for x in (-1.2, -0.6, 0.4, 1.2) if doors]
    return np.concatenate((upper, np.stack((along, np.full(len(along), -1.0)), -1), *sides))


def field_of(points: np.ndarray) -> ScoreField:
    counts = RayCounts(CONFIG, np.zeros(2))
    counts.add(np.zeros(2), points)
    return counts.field(points)


def registered(x: float, deviation: float, yaw: float = 0.0) -> Registration:
    """What lines and a prior leave: 1 cm across the corridor, ``deviation`` along it."""
    information = np.diag((0.0, 1e4, 1e5))
    prior = np.diag((deviation**-2, 1.0, 1.0))
    return Registration(np.array((x, 0.0, yaw)), inverted(information + prior), information, 1.0, 160)


@pytest.mark.parametrize("off", [-0.3, 0.2])
def test_doors_hold_the_way_along_a_corridor(off: float) -> None:
    found = registered(off, 0.3)
    held = held_along(found, field_of(corridor(True)), corridor(True, 2.0), **SETTINGS)
    deviation = math.sqrt(held.covariance[0, 0])
    assert abs(held.pose[0]) < 0.7 * abs(off) and abs(held.pose[0]) < deviation < 0.25
    # The information is that of the score alone, along the open direction alone.
    np.testing.assert_allclose(held.covariance, inverted(held.information + np.diag((0.3**-2, 1.0, 1.0))), atol=1e-9)
    np.testing.assert_allclose(held.information[1:, 1:], found.information[1:, 1:], atol=1e-6)


@pytest.mark.parametrize("off", [-0.3, 0.0, 0.3])
def test_smooth_walls_tell_nothing_of_the_way_along_them(off: float) -> None:
    """Also where a scan sees farther than any before: what was never seen speaks neither for nor against."""
    found = registered(off, 0.3)
    held = held_along(found, field_of(corridor(False, 2.0)), corridor(False, 2.0), **SETTINGS)
    assert abs(held.pose[0] - off) < 0.02
    assert held.covariance[0, 0] > 0.95 * found.covariance[0, 0]


@pytest.mark.parametrize("deviation", [1.0, 5.0])
def test_a_place_is_no_surer_than_the_offsets_are_close(deviation: float) -> None:
    """An end wall leaves one offset alone: it is 12.5 cm from the next ones."""
    end = np.stack((np.full(60, 3.0), np.arange(-1.5, 1.5, 0.05)), -1)
    found = registered(0.0, deviation)
    held = held_along(found, field_of(end), end, unknown=0.1, noise=0.5, weight=0.001)
    assert 0.03 < math.sqrt(held.covariance[0, 0]) < 0.15 and abs(held.pose[0]) < 0.06


def test_what_is_known_already_stays_as_it_is() -> None:
    found = registered(0.04, 0.05)
    assert held_along(found, field_of(corridor(True)), corridor(True), **SETTINGS) is found


def test_a_map_turned_round_tells_the_same() -> None:
    walls, seen = corridor(True), corridor(True, 2.0)
    straight = held_along(registered(0.2, 0.3), field_of(walls), seen, **SETTINGS)
    turned = np.stack((-walls[:, 1], walls[:, 0]), -1)
    rotation = np.array(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    found = registered(0.2, 0.3)
    found = Registration(
        np.array((0.0, 0.2, 0.5 * math.pi)),
        rotation @ found.covariance @ rotation.T,
        rotation @ found.information @ rotation.T,
        1.0,
        160,
    )
    held = held_along(found, field_of(turned), seen, **SETTINGS)
    np.testing.assert_allclose(held.pose, (0.0, straight.pose[0], 0.5 * math.pi), atol=0.02)
    assert held.covariance[1, 1] == pytest.approx(straight.covariance[0, 0], rel=0.3)
