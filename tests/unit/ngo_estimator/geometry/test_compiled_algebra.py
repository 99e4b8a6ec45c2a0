"""Compiled algebra of single poses, and ways through a graph, are what numpy and scipy make of them."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.geometry.planar_motion import inverted, propagated, squared_deviations
from ngo_estimator.graph.shortest_paths import shortest_paths

RANDOM = np.random.default_rng(0)


def covariance() -> np.ndarray:
    root = RANDOM.normal(size=(3, 3)) * RANDOM.uniform(1e-3, 1.0)
    return root @ root.T + 1e-6 * np.eye(3)


def test_matrices_are_inverted_as_numpy_does() -> None:
    for _ in range(200):
        a = covariance()
        np.testing.assert_allclose(inverted(a), np.linalg.inv(a), rtol=1e-12)


def test_a_single_covariance_is_propagated_as_many_are() -> None:
    for _ in range(200):
        before, step, pose, relative = covariance(), covariance(), RANDOM.normal(size=3), RANDOM.normal(size=3)
        expected = propagate(before, pose, relative, step)
        np.testing.assert_allclose(propagated(before, pose, relative, step), expected, rtol=1e-12, atol=1e-15)


def test_a_turn_counts_the_shorter_way_round() -> None:
    away = squared_deviations(np.array((1.0, 2.0, 3.1)), np.array((1.0, 1.0, -3.1)), np.diag((1.0, 4.0, 100.0)))
    assert away == pytest.approx(4.0 + 100.0 * (2.0 * np.pi - 6.2) ** 2)


@pytest.mark.parametrize("loops", [0, 1, 30, 300])
def test_shortest_paths_are_those_of_dijkstra(loops: int) -> None:
    count = 400
    chain = np.stack((np.arange(count - 1), np.arange(1, count)), axis=1)
    across = np.sort(RANDOM.integers(0, count, (loops, 2)), axis=1)
    edges = np.concatenate((chain, across[across[:, 1] > across[:, 0]]))
    lengths = RANDOM.uniform(0.01, 1.0, len(edges))
    shortest = np.full((count, count), np.inf)
    np.minimum.at(shortest, tuple(edges.T), lengths)  # of two edges between the same keys the shorter one
    rows, columns = np.nonzero(np.isfinite(shortest))
    graph = coo_array((shortest[rows, columns], (rows, columns)), shape=(count, count)).tocsr()
    for key in (0, 137, count - 1):
        expected = dijkstra(graph, directed=False, indices=key)
        np.testing.assert_allclose(shortest_paths(edges, lengths, count, key), expected, rtol=1e-12)
