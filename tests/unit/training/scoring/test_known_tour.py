"""The tour on a known map, on graphs of which the shortest is known."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from training.scoring.known_tour import Sights, shortest_tour


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
