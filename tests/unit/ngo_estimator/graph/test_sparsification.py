"""Which nodes and edges of a pose graph may go, and what takes their place."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.se2 import between
from ngo_estimator.graph.corrector import normal_equations
from ngo_estimator.graph.cycle_agreement import chain_poses
from ngo_estimator.graph.marginalisation import neighbour_tree
from ngo_estimator.graph.redundant_nodes import redundant_nodes
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.sparsification import WALLS_M, largest_variances, needed_loops

DEVIATIONS = np.array((0.02, 0.03, 0.01))


def edges(poses: np.ndarray, nodes: list[tuple[int, int]]) -> RelativePoses:
    """Measurements without errors."""
    pairs = np.array(nodes)
    relative = between(poses[pairs[:, 0]], poses[pairs[:, 1]])
    return RelativePoses.of_deviations(pairs, relative, np.tile(DEVIATIONS, (len(pairs), 1)))


def relative_covariance(poses: np.ndarray, graph: RelativePoses, pair: np.ndarray) -> np.ndarray:
    """Covariance of one node as seen from another, in a whole graph with node 0 known."""
    joint = np.zeros((6, 6))
    information = normal_equations(poses, (graph, np.ones(len(graph))))
    known = pair > 0
    joint[np.ix_(*[np.repeat(known, 3)] * 2)] = information.covariance(pair[known])
    plain = RelativePoses(pair[None], np.zeros((1, 3)), np.eye(3)[None])
    jacobian = plain.whitened_jacobian(poses)[0]
    return np.asarray(jacobian @ joint @ jacobian.T)


@pytest.fixture
def poses() -> np.ndarray:
    return chain_poses(np.tile((0.7, 0.1, math.radians(25.0)), (9, 1)))


def test_without_loops_a_stretch_is_a_step_that_adds_up_its_own(poses: np.ndarray) -> None:
    steps = edges(poses, [(k, k + 1) for k in range(9)])
    tree = neighbour_tree(poses, np.arange(3, 6), steps[2:6])
    assert tree.nodes.tolist() == [[2, 6]]
    np.testing.assert_allclose(tree.relative[0], between(poses[2], poses[6]))
    np.testing.assert_allclose(tree.covariance[0], relative_covariance(poses, steps, np.array((2, 6))), rtol=1e-5)


def test_each_edge_of_the_tree_is_as_sure_as_its_nodes_were(poses: np.ndarray) -> None:
    """Nodes 4 and 5 leave, which loops join with 0, 1 and 8. The rest of the graph says nothing of these."""
    own = edges(poses, [(3, 4), (4, 5), (5, 6), (0, 4), (1, 5), (4, 8)])
    # All in one piece for the whole graph, by edges that know next to nothing.
    loose = edges(poses, [(k, k + 1) for k in range(9)])
    whole = RelativePoses(
        *(np.concatenate((a, b)) for a, b in ((own.nodes, loose.nodes), (own.relative, loose.relative))),
        np.concatenate((own.root, 1e-5 * loose.root)),
    )
    tree = neighbour_tree(poses, np.array((4, 5)), own)
    assert tree.nodes[0].tolist() == [3, 6] and len(tree.nodes) == 4  # of five neighbours
    assert (tree.nodes[:, 0] < tree.nodes[:, 1]).all() and set(tree.nodes.ravel().tolist()) == {0, 1, 3, 6, 8}
    for pair, covariance in zip(tree.nodes, tree.covariance, strict=True):
        np.testing.assert_allclose(covariance, relative_covariance(poses, whole, pair), rtol=1e-3, atol=1e-7)


def test_the_surest_edges_are_kept(poses: np.ndarray) -> None:
    """A loop that is ten times as sure ties its node to the nearer end of the stretch."""
    own = edges(poses, [(3, 4), (4, 5), (5, 6), (1, 5)])
    root = own.root.copy()
    root[2:] *= 10.0
    tree = neighbour_tree(poses, np.array((4, 5)), RelativePoses(own.nodes, own.relative, root))
    assert tree.nodes.tolist() == [[3, 6], [1, 6]]


NONE = np.zeros(0, np.int64)


def circles(rounds: int) -> np.ndarray:
    turn = np.linspace(0.0, 2.0 * rounds * math.pi, 60 * rounds, endpoint=False)
    return np.column_stack((3.0 * np.sin(turn), -3.0 * np.cos(turn), turn))


def line(count: int) -> np.ndarray:
    return np.column_stack((10.0 + 0.3 * np.arange(count), np.zeros((count, 2))))


def newest(poses: np.ndarray, count: int) -> np.ndarray:
    return np.arange(len(poses)) >= len(poses) - count


def test_the_oldest_of_five_rounds_leave_and_every_place_stays() -> None:
    poses = np.concatenate((circles(5), line(60)))
    leaves = redundant_nodes(poses, NONE, np.zeros(len(poses)), newest(poses, 15), 180)
    assert 180 <= leaves.sum() < 180 + 30 and not leaves[240:].any()
    kept = poses[:300][~leaves[:300]]
    assert np.linalg.norm(poses[:300, None, :2] - kept[None, :, :2], axis=-1).min(1).max() < 1.0


def test_nothing_leaves_where_everything_was_seen_once() -> None:
    assert not redundant_nodes(line(200), NONE, np.zeros(200), newest(line(200), 30), 150).any()


def test_a_place_seen_in_another_direction_is_another_view() -> None:
    there, back = line(100), line(100)[::-1].copy()
    back[:, 2] = math.pi
    poses = np.concatenate((there, back))
    assert not redundant_nodes(poses, NONE, np.zeros(200), newest(poses, 0), 150).any()


def test_only_in_one_part_of_the_map_do_poses_say_what_is_near() -> None:
    poses, parts = circles(2), np.repeat((0, 1), 60)
    assert redundant_nodes(poses, NONE, np.zeros(120), newest(poses, 0), 60).any()
    assert not redundant_nodes(poses, np.array((60,)), parts, newest(poses, 0), 60).any()


def test_runs_do_not_reach_over_a_border() -> None:
    poses = circles(3)
    borders = np.array((70, 75, 120))
    leaves = redundant_nodes(poses, borders, np.zeros(180), newest(poses, 60), 10)
    first, last = np.flatnonzero(leaves)[[0, -1]]
    stretch = np.searchsorted(borders, (first, last), side="right")
    assert leaves[first : last + 1].all() and stretch[0] == stretch[1]


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
