"""Which loops a graph needs, with answers worked out by hand."""

import math

import numpy as np
import pytest

from ngo_estimator.graph.sparsification import WALLS_M, largest_variances, needed_loops

CHAIN = np.array([(k, k + 1) for k in range(20)])


def needed(pairs: list[tuple[int, int]], surprising: bool = False, redundant: float = 5.0) -> list[bool]:
    """Of loops as sure as a step, in a chain of 21 keys."""
    count = len(pairs)
    found = needed_loops(
        CHAIN, np.ones(len(CHAIN)), np.array(pairs), np.ones(count), np.full(count, surprising), redundant
    )
    return found.tolist()


@pytest.mark.parametrize(("later", "expected"), [(5, False), (6, True)])
def test_a_loop_is_needed_where_the_path_round_is_less_sure(later: int, expected: bool) -> None:
    assert needed([(0, later)]) == [expected]


def test_a_loop_beside_one_that_is_kept_adds_nothing_new() -> None:
    # From 19 to 1 it is one step, a loop and one step; from 15 to 4 five, a loop and four; from 0 to 10 as far.
    assert needed([(0, 20), (1, 19), (4, 15), (0, 10)]) == [True, False, True, True]


def test_a_loop_that_surprises_is_needed_in_any_case() -> None:
    assert needed([(0, 2)], surprising=True) == [True]


def test_of_two_edges_between_the_same_keys_the_surer_counts() -> None:
    edges = np.concatenate((CHAIN, [(0, 20), (0, 20)]))
    variance = np.concatenate((np.ones(len(CHAIN)), (9.0, 1.0)))
    found = needed_loops(edges, variance, np.array([(0, 20)]), np.ones(1), np.zeros(1, bool), 5.0)
    assert not found.any()


def test_the_loops_of_a_robot_that_stays_in_a_place_do_not_grow_dense() -> None:
    """It turns on the spot: with every tenth key it sees again what it saw a turn ago, and two turns ago."""
    turns, keys_per_turn = 40, 24
    count = turns * keys_per_turn
    edges = np.array([(k, k + 1) for k in range(count)])
    variance, kept, asked = np.ones(count), 0, 0
    for key in range(2 * keys_per_turn, count, 2):
        pairs = np.array([(key - keys_per_turn, key), (key - 2 * keys_per_turn, key)])
        found = needed_loops(edges[: key + kept], variance[: key + kept], pairs, np.ones(2), np.zeros(2, bool), 15.0)
        new = pairs[found]
        edges = np.concatenate((edges[: key + kept], new, edges[key + kept :]))
        variance = np.ones(len(edges))
        kept, asked = kept + len(new), asked + 2
    assert 0 < kept < 0.2 * asked


def test_an_error_of_heading_counts_by_what_it_moves_at_the_walls() -> None:
    covariance = np.stack((np.diag((0.01, 0.04, 1e-6)), np.diag((1e-6, 1e-6, math.radians(1.0) ** 2))))
    np.testing.assert_allclose(largest_variances(covariance), (0.04, (WALLS_M * math.radians(1.0)) ** 2))
