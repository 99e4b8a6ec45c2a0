"""Nodes that leave a pose graph: what their edges say about the nodes around is kept in a tree of edges between these.

Of all trees it is the one of the surest edges, each with its covariance in the graph as it was (Chow and Liu 1968;
Kretzschmar and Stachniss, "Information-theoretic compression of pose graphs", 2012). So the graph stays sparse.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

from ngo_estimator.geometry.se2 import between
from ngo_estimator.graph.relative_poses import RelativePoses


@dataclass(frozen=True)
class NeighbourTree:
    """Edges between the neighbours of nodes that left: ``nodes`` ``(n, 2)``, the earlier first, the later one seen from
    it ``relative`` ``(n, 3)`` and its ``covariance`` ``(n, 3, 3)``, along the axes of the earlier. The first is the
    edge of the ``chain``."""

    nodes: np.ndarray
    relative: np.ndarray
    covariance: np.ndarray


def neighbour_tree(poses: np.ndarray, gone: np.ndarray, edges: RelativePoses) -> NeighbourTree:
    """The tree that stands for a stretch of a chain.

    Args:
        poses: of all nodes ``(nodes, 3)``; the edges are linearised there.
        gone: the nodes that leave, ``first`` to ``last`` without a gap; both ends of the stretch stay.
        edges: all that join a node that leaves.
    """
    nodes = np.unique(edges.nodes)
    leaves = (nodes >= gone[0]) & (nodes <= gone[-1])
    information = _information(poses, nodes, edges)
    stay, covariance = nodes[~leaves], _marginal_covariance(information, leaves)
    pairs = np.stack(np.triu_indices(len(stay), 1), axis=1)
    between_pairs = _relative_covariances(poses, stay[pairs], pairs, covariance)
    cost = np.linalg.slogdet(between_pairs)[1]
    is_chain = (stay[pairs] == (gone[0] - 1, gone[-1] + 1)).all(1)
    cost += 2.0 - cost.min()
    cost[is_chain] = 1.0  # the cheapest: no zeros, which would be no edges
    costs = np.zeros((len(stay), len(stay)))
    costs[pairs[:, 0], pairs[:, 1]] = cost
    tree = minimum_spanning_tree(costs).toarray()[pairs[:, 0], pairs[:, 1]] > 0.0
    chosen = np.concatenate((np.flatnonzero(is_chain), np.flatnonzero(tree & ~is_chain)))
    ends = stay[pairs[chosen]]
    return NeighbourTree(ends, between(poses[ends[:, 0]], poses[ends[:, 1]]), between_pairs[chosen])


def _information(poses: np.ndarray, nodes: np.ndarray, edges: RelativePoses) -> np.ndarray:
    """Information ``(n, n, 3, 3)`` of edges between ``nodes`` ``(n,)``, ascending."""
    jacobian, at = edges.whitened_jacobian(poses), np.searchsorted(nodes, edges.nodes)
    blocks = (jacobian.mT @ jacobian).reshape(-1, 2, 3, 2, 3)
    information = np.zeros((len(nodes), len(nodes), 3, 3))
    for row in (0, 1):
        for column in (0, 1):
            np.add.at(information, (at[:, row], at[:, column]), blocks[:, row, :, column])
    return information


def _marginal_covariance(information: np.ndarray, leaves: np.ndarray) -> np.ndarray:
    """Covariance ``(n, n, 3, 3)`` of the nodes that stay, where the first of them is known."""
    order = np.concatenate((np.flatnonzero(leaves), np.flatnonzero(~leaves)))
    known = int(leaves.sum())
    free = np.delete(order, known)
    flat = information[np.ix_(free, free)].transpose(0, 2, 1, 3).reshape(3 * len(free), 3 * len(free))
    stay = len(order) - known
    covariance = np.zeros((stay, stay, 3, 3))
    inverse = np.linalg.inv(flat)[3 * known :, 3 * known :]
    covariance[1:, 1:] = inverse.reshape(stay - 1, 3, stay - 1, 3).transpose(0, 2, 1, 3)
    return covariance


def _relative_covariances(
    poses: np.ndarray, nodes: np.ndarray, pairs: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Covariance ``(m, 3, 3)`` of the second of each pair of nodes ``(m, 2)``, seen from the first.

    ``pairs`` ``(m, 2)`` are the same among the nodes with the joint ``covariance`` ``(n, n, 3, 3)``.
    """
    plain = np.broadcast_to(np.eye(3), (len(nodes), 3, 3))
    jacobian = RelativePoses(nodes, np.zeros((len(nodes), 3)), plain).whitened_jacobian(poses)
    joint = covariance[pairs[:, :, None], pairs[:, None, :]].transpose(0, 1, 3, 2, 4).reshape(-1, 6, 6)
    of_pairs: np.ndarray = jacobian @ joint @ jacobian.mT
    return 0.5 * (of_pairs + of_pairs.mT)
