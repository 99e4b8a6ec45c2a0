"""What nodes that leave a graph said about their neighbours stays, and nothing is added to it."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.se2 import between
from ngo_estimator.graph.corrector import normal_equations
from ngo_estimator.graph.cycle_agreement import chain_poses
from ngo_estimator.graph.marginalisation import neighbour_tree
from ngo_estimator.graph.relative_poses import RelativePoses

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
