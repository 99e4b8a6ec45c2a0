"""The learned corrector: a network says which loops are right, the graph is solved with these, and again.

Attend, optimise, and again, as the paper's optimizer does. What comes of it are candidates: the truncated cost judges.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch

from ngo_estimator.graph.corrector import GraphProblem, Told, normal_equations, silent
from ngo_estimator.graph.crowds import CrowdAware
from ngo_estimator.graph.cycle_agreement import chain_poses
from ngo_estimator.graph.graduated import graduate
from ngo_estimator.graph.loop_features import LoopFeatures, LoopView
from ngo_estimator.graph.normal_equations import GraphStructure
from ngo_estimator.graph.relative_poses import BELIEVED
from ngo_estimator.graph.robust import LEAST_SCALE
from ngo_estimator.networks.loop_attention import LoopAttention

ITERATIONS = 3
"""How often the network looks, each time at poses that it has corrected."""

_LEAST_WEIGHT = 0.1
"""A loop that is believed less leaves the graph: wrong loops fill its factor."""

_FEW = 20
"""A graph with fewer loops is left to the robust corrector."""

_MOST_STEPS = 8
_AT_REST = 1e-2
"""Size of a step (m, rad) below which poses are good enough to look again."""


def tensors(features: LoopFeatures) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What the network takes."""
    return torch.from_numpy(features.tokens), torch.from_numpy(features.partners), torch.from_numpy(features.pairs)


def solved(problem: GraphProblem, poses: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Poses ``(nodes, 3)`` of least squares with so much of each loop's information, from poses on."""
    kept = np.flatnonzero(weights > _LEAST_WEIGHT)
    weights = problem.trust * weights
    loops = problem.loops[kept]
    structure = GraphStructure(np.concatenate((problem.steps.nodes, loops.nodes)), len(poses))
    for _ in range(_MOST_STEPS):
        parts = (problem.steps, np.ones(len(problem.steps))), (loops, weights[kept])
        step = normal_equations(poses, *parts, structure=structure).solution()
        poses = poses + step
        if np.abs(step).max() < _AT_REST:
            break
    return poses


@torch.no_grad()
def iterated(network: LoopAttention, problem: GraphProblem) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Poses ``(nodes, 3)`` and weights ``(loops,)`` after each iteration, from the chain on."""
    view, weights = LoopView(problem), np.zeros(len(problem.loops))
    poses = chain_poses(problem.steps.relative, problem.poses[0])
    for _ in range(ITERATIONS):
        weights = network(*tensors(view.under(poses, weights))).sigmoid().double().numpy()
        poses = solved(problem, poses, weights)
        yield poses, weights


class LearnedCorrector(CrowdAware):
    """Judges the robust solutions, the network's, and that of graduated non-convexity over the loops that it believes.

    Args:
        network: which loops are right.
        told, least_scale: see ``Robust``.
    """

    def __init__(self, network: LoopAttention, told: Told = silent, least_scale: float = LEAST_SCALE) -> None:
        super().__init__(told, least_scale)
        self._network = network

    def candidates(self, problem: GraphProblem, fair: GraphProblem) -> Iterable[np.ndarray]:
        """See ``CrowdAware``."""
        yield from super().candidates(problem, fair)
        if len(fair.loops) < _FEW:
            return
        *_, (poses, weights) = iterated(self._network, fair)
        yield poses
        rows = np.flatnonzero(weights >= BELIEVED)
        believed = replace(fair, loops=fair.loops[rows], trust=fair.trust[rows], similarity=None)
        chain = chain_poses(fair.steps.relative, fair.poses[0])
        yield graduate(believed, chain, told=self._told)[0]
