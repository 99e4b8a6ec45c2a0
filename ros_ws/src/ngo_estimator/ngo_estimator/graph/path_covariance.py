"""How well a graph knows one of its nodes against another: the covariance along the surest path between them.

One path knows less than all of them together, so that the covariance is no smaller than the graph's.
"""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ngo_estimator.graph.sparsification import largest_variances


def path_covariances(poses: np.ndarray, edges: np.ndarray, covariance: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Covariances ``(n, 3, 3)`` of the second node of each pair ``(n, 2)`` against the first, along the map's axes.

    Args:
        poses: of all nodes in the map ``(nodes, 3)``.
        edges: nodes ``(e, 2)`` that the graph joins, in one piece, with the covariance of each ``(e, 3, 3)``, along the
            axes of its first node.
    """
    count, variance = len(poses), largest_variances(covariance)
    # Of several edges between two keys the path leads over the surest.
    codes = edges.min(1) * count + edges.max(1)
    order = np.lexsort((variance, codes))
    known, first = np.unique(codes[order], return_index=True)
    later, which = np.unique(pairs[:, 1], return_inverse=True)
    graph = _edge_graph(edges, variance, count)
    _, before = dijkstra(graph, directed=False, indices=later, return_predecessors=True)
    result = np.zeros((len(pairs), 3, 3))
    for n, (key, end) in enumerate(pairs.tolist()):
        towards, keys = before[which[n]], [key]
        while keys[-1] != end:
            keys.append(int(towards[keys[-1]]))
        steps = np.stack((keys[:-1], keys[1:]), axis=1)
        path = order[first[np.searchsorted(known, steps.min(1) * count + steps.max(1))]]
        start, pivot = poses[edges[path, 0]], poses[edges[path, 1]]
        # An edge's error moves and turns all that lies behind it, about its second key.
        moved = np.zeros((len(path), 3, 3))
        moved[:, 0, 0] = moved[:, 1, 1] = np.cos(start[:, 2])
        moved[:, 1, 0], moved[:, 2, 2] = np.sin(start[:, 2]), 1.0
        moved[:, 0, 1] = -moved[:, 1, 0]
        moved[:, 0, 2], moved[:, 1, 2] = pivot[:, 1] - poses[end, 1], poses[end, 0] - pivot[:, 0]
        result[n] = (moved @ covariance[path] @ moved.mT).sum(0)
    return result


def _edge_graph(edges: np.ndarray, variance: np.ndarray, count: int) -> csr_array:
    """A graph of ``count`` keys whose edges ``(e, 2)`` are as long as their variances ``(e,)``; doubles count once."""
    # A sparse array sums what it is given twice: of several edges between two keys the surest one counts.
    order = np.lexsort((variance, edges[:, 1], edges[:, 0]))
    edges, variance = edges[order], variance[order]
    first = np.append(True, (np.diff(edges, axis=0) != 0).any(1))
    return csr_array((variance[first], (edges[first, 0], edges[first, 1])), shape=(count, count))
