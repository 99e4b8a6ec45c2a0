"""Sparsification: which loops a graph needs. One between keys that it knows against each other adds nothing new.

What is kept is a spanner of the graph: where a loop is left out, a path over others is nearly as sure.
The cost of an optimisation then follows what the robot saw, and not how often it saw it.
"""

import numpy as np

from ngo_estimator.graph.shortest_paths import shortest_paths

WALLS_M = 4.0
"""Distance of the walls: an error of heading counts by what it moves there."""


def largest_variances(covariance: np.ndarray) -> np.ndarray:
    """Largest variance ``(n,)`` (m^2) of poses with covariances ``(n, 3, 3)`` in any direction, at the walls."""
    arm = np.array((1.0, 1.0, WALLS_M))
    largest: np.ndarray = np.linalg.eigvalsh(covariance * np.outer(arm, arm))[:, -1]
    return largest


def needed_loops(
    edges: np.ndarray, edge_variance: np.ndarray, pairs: np.ndarray, own_variance: np.ndarray, surprising: np.ndarray,
    redundant: float,
) -> np.ndarray:  # fmt: skip
    """Which of some new loops ``(n,)`` a graph needs, in their order.

    A loop is needed where no path through the graph joins its keys with at most ``redundant`` times its variance, or
    where it is ``surprising`` ``(n,)``.

    Args:
        edges: keys ``(e, 2)`` that the graph joins, with the largest variance of each ``(e,)``.
        pairs: of the new loops ``(n, 2)``, the earlier key first, with their own ``(n,)``.
    """
    variance, joined = np.concatenate((edge_variance, own_variance)), np.concatenate((edges, pairs))
    kept = np.append(np.ones(len(edges), bool), np.zeros(len(pairs), bool))
    count = int(joined.max(initial=0)) + 1
    for k, (earlier, later) in enumerate(pairs):
        limit = redundant * own_variance[k]
        known = shortest_paths(joined[kept], variance[kept], count, later)[earlier] <= limit
        kept[len(edges) + k] = surprising[k] or not known
    return kept[len(edges) :]
