"""Wrong loops fed into a graph, as places that look alike give them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.configuration import check
from ngo_estimator.graph.relative_poses import RelativePoses

_GROUP = 5


@dataclass(frozen=True)
class WrongLoopsConfig:
    """Wrong loops are ``percent`` of all, or none; they are drawn once for each of the ``seeds``."""

    percent: float
    seeds: Sequence[int] = (0, 1, 2)

    def __post_init__(self) -> None:
        check(self, "percent", "from 0 on, below 100", lambda x: 0.0 <= x < 100.0)
        check(self, "seeds", "one or more, from 0 on", lambda x: x >= 0)


def with_wrong_loops(loops: RelativePoses, nodes: int, percent: float, rng: np.random.Generator) -> RelativePoses:
    """The loops of a graph of so many nodes, and behind them wrong ones, ``percent`` of all.

    A wrong loop is a right one that took another node for its first. Five loops in a row are wrong in the same way, so
    that they agree with each other: the robot took a place for another one that looks alike.
    """
    right = len(loops.nodes)
    wrong = round(right * percent / (100.0 - percent))
    if wrong == 0 or nodes < 3:
        return loops
    starts = rng.integers(right, size=-(-wrong // _GROUP))
    rows = ((starts[:, None] + np.arange(_GROUP)) % right).ravel()[:wrong]
    pairs = loops.nodes[rows].copy()
    pairs[:, 0] = (pairs[:, 0] + np.repeat(rng.integers(1, nodes, size=len(starts)), _GROUP)[:wrong]) % nodes
    kept = np.abs(pairs[:, 0] - pairs[:, 1]) > 1  # others would be steps, or join a node with itself
    return RelativePoses(
        np.concatenate((loops.nodes, pairs[kept])),
        np.concatenate((loops.relative, loops.relative[rows][kept])),
        np.concatenate((loops.root, loops.root[rows][kept])),
    )
