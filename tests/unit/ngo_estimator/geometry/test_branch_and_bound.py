"""Branch and bound finds the pose that brute force finds, and says whether another fits nearly as well."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ngo_estimator.geometry.branch_and_bound import PooledGrid, SearchConfig, pooled_grid, search

CONFIG = SearchConfig(least_response=0.0, least_second=0.0)


def wall(start: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
    count = math.ceil(math.dist(start, end) / 0.05)
    return np.linspace(start, end, count)


def room() -> np.ndarray:
    """An L with a pillar: no symmetry."""
    corners = [(0.0, 0.0), (6.0, 0.0), (6.0, 2.5), (3.0, 2.5), (3.0, 4.0), (0.0, 4.0), (0.0, 0.0)]
    walls = [wall(a, b) for a, b in zip(corners[:-1], corners[1:], strict=True)]
    return np.concatenate([*walls, wall((1.0, 2.8), (1.4, 3.1))])


def seen_from(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    return (points - pose[:2]) @ np.array(((cosine, -sine), (sine, cosine)))


def brute_force(
    config: SearchConfig, grid: PooledGrid, points: np.ndarray, centre: np.ndarray, half: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """All poses of the lattice ``(n, 3)`` and their responses ``(n,)``, straight from the definition."""
    poses, responses = [], []
    fine = grid.levels[0]
    for turn in range(-half[2], half[2] + 1):
        heading = centre[2] + turn * math.radians(config.heading_step_deg)
        cosine, sine = math.cos(heading), math.sin(heading)
        turned = points @ np.array(((cosine, sine), (-sine, cosine))) + centre[:2]
        for across in range(-half[0], half[0] + 1):
            for up in range(-half[1], half[1] + 1):
                moved = np.array((across, up)) * config.resolution_m
                # Cells first, then the shift: a shift by whole cells must not round.
                cells = np.floor((turned - grid.origin_m) / config.resolution_m).astype(int) + (across, up)
                inside = (cells >= 0).all(1) & (cells[:, 0] < fine.shape[1]) & (cells[:, 1] < fine.shape[0])
                values = fine[cells[inside, 1], cells[inside, 0]].astype(float)
                poses.append((*(centre[:2] + moved), heading))
                responses.append(values.sum() / 255.0 / len(points))
    return np.array(poses), np.array(responses)


def separated(config: SearchConfig, poses: np.ndarray, best: np.ndarray) -> np.ndarray:
    away = np.linalg.norm(poses[:, :2] - best[:2], axis=1)
    turn = np.abs((poses[:, 2] - best[2] + math.pi) % (2.0 * math.pi) - math.pi)
    return (away > config.separation_m + 1e-9) | (turn > math.radians(config.separation_deg) + 1e-9)


@settings(max_examples=15, deadline=None)
@given(
    x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5), turn=st.floats(-0.2, 0.2), depth=st.integers(0, 5),
    half=st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(0, 4)), seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_the_search_equals_brute_force(
    x: float, y: float, turn: float, depth: int, half: tuple[int, int, int], seed: int
) -> None:
    config = SearchConfig(depth=depth, least_response=0.0, least_second=0.0, separation_m=0.3, separation_deg=5.0)
    random = np.random.default_rng(seed)
    truth = np.array((2.0, 1.2, 0.4))
    points = random.permutation(seen_from(truth, room()))[:80] + random.normal(0.0, 0.02, (80, 2))
    grid, centre = pooled_grid(config, room()), truth + (x, y, turn)
    window = np.array((*(np.array(half[:2]) * config.resolution_m), half[2] * math.radians(config.heading_step_deg)))
    match = search(config, grid, points, centre, window + 1e-6)
    poses, responses = brute_force(config, grid, points, centre, half)
    assert match is not None
    assert match.response == pytest.approx(responses.max(), abs=1e-12)
    (at,) = np.flatnonzero(np.abs(poses - match.pose).max(1) < 1e-6)
    assert responses[at] == pytest.approx(responses.max(), abs=1e-12)
    others = responses[separated(config, poses, match.pose)]
    assert match.second == pytest.approx(others.max() if len(others) else 0.0, abs=1e-12)


def test_a_pose_metres_away_and_turned_by_any_angle_is_found() -> None:
    truth = np.array((2.0, 1.2, 2.9))
    match = search(
        CONFIG, pooled_grid(CONFIG, room()), seen_from(truth, room()), np.array((-3.0, 4.0, -1.0)),
        np.array((8.0, 8.0, math.pi)),
    )  # fmt: skip
    assert match is not None
    assert np.linalg.norm(match.pose[:2] - truth[:2]) < CONFIG.resolution_m
    turn = (match.pose[2] - truth[2] + math.pi) % (2.0 * math.pi) - math.pi
    assert abs(turn) <= math.radians(CONFIG.heading_step_deg)
    assert match.response > 0.8 and match.second < 0.85 * match.response


def test_of_two_rooms_that_are_alike_the_second_is_a_second_peak() -> None:
    both = np.concatenate((room(), room() + (6.0 + 0.24, 0.0)))
    truth = np.array((2.0, 1.2, 0.0))
    match = search(
        CONFIG, pooled_grid(CONFIG, both), seen_from(truth, room()), truth + (1.0, 0.0, 0.0), np.array((8.0, 2.0, 0.3))
    )
    assert match is not None
    assert match.second > 0.95 * match.response


def test_a_search_near_places_finds_what_is_near_one_of_them_and_nothing_else() -> None:
    grid, truth = pooled_grid(CONFIG, room()), np.array((2.0, 1.2, 2.9))
    seen, window = seen_from(truth, room()), np.array((8.0, 8.0, math.pi))
    everywhere = search(CONFIG, grid, seen, np.zeros(3), window)
    assert everywhere is not None
    for places in (((2.5, 1.0), (-6.0, 5.0)), ((2.0, 2.1), (2.1, 2.0))):
        near = search(CONFIG, grid, seen, np.zeros(3), window, (np.array(places), 1.0))
        assert near is not None
        np.testing.assert_array_equal(near.pose, everywhere.pose)
    far = search(CONFIG, grid, seen, np.zeros(3), window, (np.array(((-4.0, 5.0), (6.0, -3.0))), 1.0))
    assert far is not None
    block_m = 16 * CONFIG.resolution_m
    away = min(math.dist(far.pose[:2], place) for place in ((-4.0, 5.0), (6.0, -3.0)))
    assert away <= 1.0 + block_m * math.sqrt(2.0) and far.response < everywhere.response


def test_a_search_that_is_cut_short_gives_an_upper_bound_or_nothing() -> None:
    truth, window = np.array((2.0, 1.2, 0.4)), np.array((3.0, 3.0, 0.3))
    points = seen_from(truth, room())
    whole = search(CONFIG, pooled_grid(CONFIG, room()), points, truth, window)
    assert whole is not None
    found = 0
    for most in (1, 5, 10, 20, 50, 100, 200, 400):
        config = SearchConfig(least_response=0.0, least_second=0.0, most_blocks=most)
        match = search(config, pooled_grid(config, room()), points, truth, window)
        if match is not None:
            found += 1
            assert match.response == whole.response
            assert match.second >= whole.second
    assert 0 < found < 8
