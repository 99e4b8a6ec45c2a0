"""The loops and the steps of a graph of key scans without some of its nodes."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.graph.marginalisation import NeighbourTree, neighbour_tree
from ngo_estimator.graph.relative_poses import BELIEVED, RelativePoses
from ngo_estimator.loops.scan_loops import EVIDENCE, ScanLoops
from ngo_estimator.loops.scan_submaps import SUBMAP_VARIANCE


@dataclass(frozen=True)
class ThinnedGraph:
    """Of nodes that are numbered as before: the ``loops`` with their ``weights`` ``(n,)``, and the steps over gaps."""

    loops: ScanLoops
    weights: np.ndarray
    bridges: NeighbourTree


def without_nodes(
    poses: np.ndarray, steps: RelativePoses, loops: ScanLoops, weights: np.ndarray, leaves: np.ndarray
) -> ThinnedGraph:
    """Let nodes go, one stretch of the chain after the other; loops that are not believed there go with them.

    Args:
        poses: of all nodes ``(nodes, 3)``.
        steps: from each node to the next.
        loops, weights: that the graph has, and the belief in each ``(n,)``.
        leaves: which nodes go ``(nodes,)``; not the first, nor the last.
    """
    change = np.flatnonzero(np.diff(leaves.astype(np.int8)))
    bridges = []
    for first, last in zip((change[::2] + 1).tolist(), change[1::2].tolist(), strict=True):
        there = ((loops.pairs >= first) & (loops.pairs <= last)).any(1)
        known = there & (weights > BELIEVED)
        of_loops = RelativePoses.of_covariances(
            loops.pairs[known], loops.relative[known], loops.covariance[known] / weights[known, None, None]
        )
        tree = neighbour_tree(poses, np.arange(first, last + 1), steps[first - 1 : last + 1].extended(of_loops))
        bridges.append((tree.nodes[:1], tree.relative[:1], tree.covariance[:1]))
        made = _loops(tree)
        loops = loops[~there].extended(made)
        weights = np.concatenate((weights[~there], np.ones(len(made))))
    return ThinnedGraph(loops, weights, NeighbourTree(*map(np.concatenate, zip(*bridges, strict=True))))


def _loops(tree: NeighbourTree) -> ScanLoops:
    """The edges but that of the chain; where scans err together, many of them know no more than one."""
    count = len(tree.nodes) - 1
    evidence = np.zeros((count, len(EVIDENCE)))
    evidence[:, EVIDENCE.index("agreeing")] = 1.0
    covariance = tree.covariance[1:] + SUBMAP_VARIANCE
    return ScanLoops(tree.nodes[1:], tree.relative[1:], covariance, evidence, np.ones(count, bool))
