"""How well a graph knows one of its nodes against the others: covariances along the surest paths between them.

One path knows less than all of them together, so that the covariance is no smaller than the graph's.
"""

import math

import numpy as np
from numba import njit

from ngo_estimator.graph.shortest_paths import paths_from
from ngo_estimator.graph.sparsification import largest_variances


def path_covariances(poses: np.ndarray, edges: np.ndarray, covariance: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Covariances ``(n, 3, 3)`` of each pair's second node ``(n, 2)`` against its first; see ``covariances_of``."""
    later, which = np.unique(pairs[:, 1], return_inverse=True)
    variance, result = largest_variances(covariance), np.zeros((len(pairs), 3, 3))
    for k, node in enumerate(later.tolist()):
        result[which == k] = covariances_of(poses, edges, covariance, variance, node)[pairs[which == k, 0]]
    return result


@njit(cache=True)
def covariances_of(
    poses: np.ndarray, edges: np.ndarray, covariance: np.ndarray, variance: np.ndarray, node: int
) -> np.ndarray:
    """Covariances ``(nodes, 3, 3)`` of a node against each other, along the map's axes; infinite where no path leads.

    Args:
        poses: of all nodes in the map ``(nodes, 3)``.
        edges: nodes ``(e, 2)`` that the graph joins, the chain first.
        covariance: of each ``(e, 3, 3)``, along the axes of its first node.
        variance: the largest of each ``(e,)``; infinite where no path may lead.
    """
    distance, by = paths_from(edges, variance, len(poses), node)
    result, moved = np.full((len(poses), 3, 3), math.inf), np.eye(3)
    result[node] = 0.0
    for key in np.argsort(distance):
        if by[key] < 0:
            continue
        first, second = edges[by[key]]
        # An edge's error moves and turns all that lies behind it, about its second node.
        cos, sin = math.cos(poses[first, 2]), math.sin(poses[first, 2])
        moved[0, 0], moved[0, 1], moved[0, 2] = cos, -sin, poses[second, 1] - poses[node, 1]
        moved[1, 0], moved[1, 1], moved[1, 2] = sin, cos, poses[node, 0] - poses[second, 0]
        result[key] = result[first if key == second else second] + moved @ covariance[by[key]] @ moved.T
    return result
