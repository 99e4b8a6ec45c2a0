"""The tour on a known map, on graphs of which the shortest is known."""

from collections.abc import Sequence
from itertools import pairwise, permutations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from training.scoring.known_tour import Sights, in_order, shortest_tour


def sights(edges: list[tuple[int, int]], start: int) -> Sights:
    """Places a metre apart along edges; each shows a cell of its own."""
    count = 1 + max(max(edge) for edge in edges)
    one, other = np.array(edges).T
    graph = coo_array((np.ones(len(edges)), (one, other)), shape=(count, count)).tocsr()
    stops = np.array([start, *(place for place in range(count) if place != start)])
    ways, before = dijkstra(graph, directed=False, indices=stops, return_predecessors=True)
    return Sights(np.eye(count, dtype=bool), stops, ways, before)


LINE = [(place, place + 1) for place in range(10)]


@pytest.mark.parametrize(("cells", "length_m"), [(11, 3 + 10), (8, 7), (10, 2 + 9), (1, 0)])
def test_on_a_line_the_near_end_comes_first_and_only_if_it_is_needed(cells: int, length_m: float) -> None:
    line = sights(LINE, start=3)
    order = shortest_tour(line, cells, rounds=30)
    assert order[0] == 0 and line.shown(order).sum() >= cells
    assert line.length_m(order) == length_m


def test_in_a_star_the_longest_arm_comes_last() -> None:
    arms = [[0, 1, 2], [0, 3, 4, 5], [0, 6, 7, 8, 9, 10]]
    star = sights([edge for arm in arms for edge in zip(arm[:-1], arm[1:], strict=True)], start=0)
    order = shortest_tour(star, 11, rounds=30)
    assert star.length_m(order) == 2 * 2 + 2 * 3 + 5
    assert star.passed(order)[-1] == 10


def length(order: Sequence[int] | np.ndarray, first: np.ndarray, between: np.ndarray) -> float:
    return float(first[order[0]] + sum(between[a, b] for a, b in pairwise(order)))


def test_a_way_over_seven_places_is_the_shortest_or_nearly() -> None:
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(12):
        points = rng.uniform(0.0, 10.0, (8, 2))
        gaps = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
        first, between = gaps[0, 1:].copy(), gaps[1:, 1:].copy()
        order = in_order(first, between)
        assert sorted(order) == list(range(7))
        ratios.append(length(order, first, between) / min(length(o, first, between) for o in permutations(range(7))))
    assert min(ratios) >= 1.0 - 1e-9 and np.mean(ratios) < 1.02 and max(ratios) < 1.1


def test_a_way_visits_the_near_dead_end_before_it_goes_far() -> None:
    points = np.array(((0.0, 0.0), (-2.0, 0.0), (-2.5, 0.0), (12.0, 0.0)))
    gaps = np.abs(points[:, None, 0] - points[None, :, 0])
    assert in_order(gaps[0, 1:].copy(), gaps[1:, 1:].copy()).tolist() == [0, 1, 2]
