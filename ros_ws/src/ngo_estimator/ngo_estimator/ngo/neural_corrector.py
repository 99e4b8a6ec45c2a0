"""The Neural Graph Optimizer as a corrector of pose graphs of any sensor: each node is a meta-pose of its own."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.graph.corrector import CorrectedGraph, GraphProblem, truncated_cost
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.meta_poses import with_origin
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer

_LEAST_INFORMATION = 1e-4
"""Of a loop, 1/m^2 or 1/rad^2: of a direction with less, nothing is known."""

_LEAST_TRUST = 1e-6


class NeuralCorrector:
    """A ``Corrector`` that attends, optimises and closes loops in M iterations.

    The optimizer believes the components of a step to be independent, and a loop to be as sure along x as along y. It
    believes all steps: their weights are one. Motion features, which a graph does not have, are zero.

    Args:
        optimizer: one with loops, whose meta-poses are single steps.
    """

    def __init__(self, optimizer: NeuralGraphOptimizer) -> None:
        if optimizer.block != 1 or not optimizer.config.loops:
            raise ValueError(
                f"block, loops are {optimizer.block}, {optimizer.config.loops}; expected an optimizer with loops whose "
                "meta-poses are of one step each (aggregation.halvings 0)"
            )
        self._optimizer = optimizer

    @torch.inference_mode()
    def correct(self, problem: GraphProblem, start: CorrectedGraph | None = None) -> CorrectedGraph:
        """As ``Corrector.correct``; every solution begins at the steps, whatever ``start`` is."""
        variance = np.diagonal(np.linalg.inv(problem.steps.information), axis1=1, axis2=2)
        relative, log_std = _tensor(problem.steps.relative), _tensor(0.5 * np.log(variance))
        motion = torch.zeros(1, len(problem.steps), self._optimizer.config.aggregation.motion_feature_size)
        steps = self._optimizer.aggregate(relative, log_std, motion)
        result = self._optimizer.optimize(steps, _loops(problem))
        assert result.loop_weights is not None
        chain = with_origin(se2.r2g(result.meta_relative[-1][0].double().numpy()))
        poses = se2.compose(problem.poses[0], chain)
        weights = result.loop_weights[0].double().numpy()
        return CorrectedGraph(problem, poses, weights, np.ones(len(problem.steps)), truncated_cost(problem, poses))


def _loops(problem: GraphProblem) -> Loops:
    """The problem's loops, each from its earlier node to its later one."""
    nodes, relative = problem.loops.nodes, problem.loops.relative
    turned = nodes[:, 0] > nodes[:, 1]
    measured = np.where(turned[:, None], se2.inverse(relative), relative)
    known = np.diagonal(problem.loops.information, axis1=1, axis2=2)
    known = np.stack((0.5 * (known[:, 0] + known[:, 1]), known[:, 2]), axis=-1)
    log_scale = _tensor(-0.5 * np.log(np.maximum(known, _LEAST_INFORMATION)))
    trust = _tensor(problem.trust)
    earlier = torch.from_numpy(nodes.min(axis=1)).unsqueeze(0)
    return Loops(
        start=earlier,
        end=torch.from_numpy(nodes.max(axis=1)).unsqueeze(0) - 1,
        frame=earlier,
        measured=_tensor(measured),
        log_scale=log_scale,
        spread=log_scale,
        logit=torch.logit(trust.clamp(_LEAST_TRUST, 1.0 - _LEAST_TRUST)),
        similarity=trust if problem.similarity is None else _tensor(problem.similarity[:, 0]),
        valid=trust > 0.0,
        embeddings=torch.zeros(1, len(problem.steps), 1),
    )


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float32)).unsqueeze(0)
