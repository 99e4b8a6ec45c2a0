"""Nodes that a graph can lose: stretches of its chain whose places newer nodes show.

So a graph is bounded by the place, and not by the time, and what has changed leaves it in the end.
"""

import math

import numpy as np
from scipy.spatial import KDTree

_NEAR_M, _NEAR_DEG = 1.0, 30.0
"""Nodes as near as that to each other show the same."""

_RUN = 15
"""Nodes in a row, at least, that leave together: single ones would leave holes everywhere."""

_LEAST_SHOWN = 1.0
"""So many newer nodes show what a node shows, in the mean of a run, where the run may leave."""


def redundant_nodes(
    poses: np.ndarray, borders: np.ndarray, parts: np.ndarray, stays: np.ndarray, count: int
) -> np.ndarray:
    """Nodes that may leave ``(nodes,)``: whole runs, about ``count`` nodes together or fewer.

    Args:
        poses: of all nodes ``(nodes, 3)``.
        borders: the nodes ``(b,)`` with which a stretch of the chain begins; a run is within a stretch.
        parts: the part of the map that each node is in ``(nodes,)``; only there do poses say what is near.
        stays: nodes ``(nodes,)`` that do not leave.
    """
    run = _runs(len(poses), borders)
    size = np.bincount(run).astype(np.float64)
    headings = _NEAR_M / (2.0 * math.sin(0.5 * math.radians(_NEAR_DEG)))
    yaw = poses[:, 2]
    apart = 1e3 * _NEAR_M * (1.0 + np.ptp(poses[:, :2], axis=0).max()) * parts
    at = np.column_stack((poses[:, :2], headings * np.cos(yaw), headings * np.sin(yaw), apart))
    pairs = KDTree(at).query_pairs(_NEAR_M, output_type="ndarray")
    older, newer = pairs.T if len(pairs) else np.zeros((2, 0), np.int64)  # of each pair the smaller number is first
    shown = np.zeros((len(size), len(size)))  # nodes of one run that another shows
    both = np.unique(np.column_stack((older, run[newer])), axis=0)
    np.add.at(shown, (run[both[:, 0]], both[:, 1]), 1.0)
    np.fill_diagonal(shown, 0.0)
    share = shown.sum(1) / size
    share[np.unique(run[stays])] = -np.inf
    leaves = np.zeros(len(poses), bool)
    while leaves.sum() < count and share.max() >= _LEAST_SHOWN:
        most = int(share.argmax())
        leaves |= run == most
        share -= shown[:, most] / size
        share[most] = -np.inf
    return leaves


def _runs(count: int, borders: np.ndarray) -> np.ndarray:
    """The run of each node ``(count,)``: stretches between borders in pieces of equal length, ``_RUN`` or more."""
    begins = np.unique(np.concatenate(([0], borders)))
    lengths = np.diff(np.append(begins, count))
    pieces = np.maximum(1, lengths // _RUN)
    stretch = np.repeat(np.arange(len(begins)), lengths)
    within = (np.arange(count) - begins[stretch]) * pieces[stretch] // lengths[stretch]
    run: np.ndarray = (np.cumsum(pieces) - pieces)[stretch] + within
    return run
