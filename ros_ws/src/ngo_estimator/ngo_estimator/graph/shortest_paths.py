"""Shortest paths through a graph that is a long chain with some loops, compiled."""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def paths_from(edges: np.ndarray, lengths: np.ndarray, count: int, key: int) -> tuple[np.ndarray, np.ndarray]:
    """Length ``(count,)`` of the shortest path from a key to each other, and its last edge ``(count,)``.

    They are infinite and -1 where there is none.

    Sweeps go along the edges in their order and back. One of them finds a path along a chain from end to end, so that
    few more are needed than a path has loops; the last changes nothing. Sums are those of Dijkstra's search, to the
    last bit.

    Args:
        edges: keys ``(e, 2)`` that the graph joins, the chain first, with the positive length of each ``(e,)``.
    """
    distance, by = np.full(count, math.inf), np.full(count, -1)
    distance[key] = 0.0
    changed = True
    while changed:
        changed = False
        for back in range(2):
            for k in range(len(edges)):
                edge = len(edges) - 1 - k if back else k
                a, b, length = edges[edge, 0], edges[edge, 1], lengths[edge]
                if distance[a] + length < distance[b]:
                    distance[b], by[b], changed = distance[a] + length, edge, True
                elif distance[b] + length < distance[a]:
                    distance[a], by[a], changed = distance[b] + length, edge, True
    return distance, by


@njit(cache=True)
def shortest_paths(edges: np.ndarray, lengths: np.ndarray, count: int, key: int) -> np.ndarray:
    """Length ``(count,)`` of the shortest path from a key to each other; see ``paths_from``."""
    return paths_from(edges, lengths, count, key)[0]
