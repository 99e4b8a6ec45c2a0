"""Loop closing: each iteration judges the loops under the current poses, and closes them by a Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.se2 import Values, library
from ngo_estimator.graph.gauss_newton import chain_nodes, gauss_newton_step, pick, relative_factors
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.loop_gates import (
    RobustLoopGate,
    chained,
    is_single,
    loop_residuals,
    odometry_variances,
    unchained,
)
from ngo_estimator.ngo.meta_poses import GraphState, MetaSteps, OptimizedMetaPoses

if TYPE_CHECKING:
    from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations

OVERLAPS_AFTER = 2
"""Iterations after which poses are good enough to look for frames that see the same walls."""

CHANNELS = 7
"""Channels in which the convolutions see the loops: spread residual, deviation (three each) and support."""


class NoLoopClosing:
    """Stands for ``LoopClosing`` in an optimizer without loops."""

    def look(self, state: GraphState, iteration: int) -> None:
        """Nothing."""

    def channels(self, state: GraphState) -> Tensor:
        """No channels."""
        return state.features[..., :0]

    def close(self, state: GraphState, stiffness: Tensor) -> GraphState:
        """The state as it is."""
        return state

    def with_loops(self, result: OptimizedMetaPoses) -> OptimizedMetaPoses:
        """The result as it is."""
        return result


class LoopClosing:
    """Closes the loops of one optimisation, iteration by iteration.

    For a batch, or where gradients are asked for, it works with tensors and the dense solver, else with arrays of the
    only trajectory and the sparse one.

    Args:
        gate: how much each loop is trusted.
        steps, loops: the meta-poses, and the loops between them that were found by their places.
        find_overlaps: gives further loops under corrected poses ``(batch, poses + 1, 3)``, or None.
        odometry_noise: ``(3,)`` factors between the deviations of ``steps`` and those of the odometry's real errors.
        correction_std: ``(3,)`` unit of residuals and deviations for the convolutions.
    """

    def __init__(
        self,
        gate: RobustLoopGate,
        steps: MetaSteps,
        loops: Loops,
        find_overlaps: Callable[[Tensor], Loops | None],
        odometry_noise: Tensor,
        correction_std: Tensor,
    ) -> None:
        self._keys, self._find_overlaps, self._correction_std = steps.key_frames, find_overlaps, correction_std
        self._gate, self._is_single = gate, is_single(steps)
        self._std, self._noise = self._given(steps.std), self._given(odometry_noise)
        self._take(loops)
        self._equations: NormalEquations | None = None
        self._begun = False

    def _take(self, loops: Loops) -> None:
        self._loops = loops
        self._structure: GraphStructure | None = None
        self._judged: Any = loops.of_single() if self._is_single else loops

    def _given(self, tensor: Tensor) -> Any:
        """Values of this batch, or arrays of the only trajectory."""
        values = tensor.double()
        if not self._is_single:
            return values
        return (values[0] if values.dim() > 1 else values).numpy()

    def _returned(self, values: Any) -> Tensor:
        """Tensors of what ``_given`` gave."""
        return torch.from_numpy(values).unsqueeze(0) if self._is_single else values

    def with_loops(self, result: OptimizedMetaPoses) -> OptimizedMetaPoses:
        """The result with the loops of the last ``close``; raises ``RuntimeError`` before it."""
        if not self._begun:
            raise RuntimeError("no iteration has closed loops yet; expected look() and close() before")
        return replace(
            result,
            loops=self._loops,
            loop_weights=self._returned(self._weights),
            loop_information=self._returned(self._information),
            equations=self._equations,
        )

    def look(self, state: GraphState, iteration: int) -> None:
        """Judge the loops under the current poses; the third iteration adds overlaps to them."""
        if iteration == OVERLAPS_AFTER and (overlaps := self._find_overlaps(state.poses)) is not None:
            self._take(self._loops.and_also(overlaps))
        self._adjusted, self._deviation, step_std = (
            self._given(x) for x in (state.adjusted, state.deviation, state.step_std)
        )
        self._poses = chained(self._adjusted + self._deviation)
        self._weights, self._information = judged(self._gate, self._judged, self._poses, step_std, iteration)

    def close(self, state: GraphState, stiffness: Tensor) -> GraphState:
        """Take a Gauss-Newton step from the poses of the last ``look``, so that the gated loops close.

        Args:
            stiffness: ``(batch, blocks, 3)`` or ``(3,)``: logarithm of a factor of the odometry's deviations, which is
                then limited to -3 to 3.
        """
        self._begun = True
        step_std = softened(self._std, self._given(stiffness), self._noise, self._keys)
        # It begins at the poses under which the loops were judged, before the network adjusted the odometry.
        solve = self._sparse_step if self._is_single else self._dense_step
        after = self._poses + solve(1.0 / step_std**2)
        deviation = se2.wrapped(unchained(after) - self._adjusted)
        return replace(state, deviation=self._returned(deviation), step_std=self._returned(step_std))

    def _dense_step(self, odometry: Tensor) -> Tensor:
        """Changes ``(batch, poses + 1, 3)`` of all poses, with gradients; ``odometry`` is the steps' information."""
        poses, loops = self._poses, self._judged
        # The information of a loop is the same along x and y, so that its axes may be turned.
        residuals = loop_residuals(loops.nodes, loops.measured, poses)
        turned = se2.rotate(-pick(poses, loops.nodes[..., 0])[..., 2], residuals[..., :2])
        factors = [
            relative_factors(chain_nodes(odometry.shape[1]).to(poses.device), poses, -self._deviation, odometry),
            relative_factors(
                loops.nodes, poses, torch.cat((turned, residuals[..., 2:]), dim=-1), self._information.double()
            ),
        ]
        return gauss_newton_step(factors, poses.shape[1])

    def _sparse_step(self, odometry: np.ndarray) -> np.ndarray:
        """The same changes ``(poses + 1, 3)`` without gradients."""
        # The compiler's library takes 100 MB: only those pay for it that optimise.
        from ngo_estimator.graph import normal_equations as sparse

        if self._structure is None:
            self._used = np.flatnonzero(self._judged.valid)
            self._measured = self._loops.measured[0].double().numpy()[self._used]
            chain = np.arange(len(odometry))
            ends = self._loops.start[0].numpy(), self._loops.end[0].numpy() + 1
            loops = np.stack(ends, axis=-1)[self._used]
            nodes = np.concatenate((np.stack((chain, chain + 1), axis=-1), loops))
            self._structure = sparse.GraphStructure(nodes, len(odometry) + 1)
        relative = np.concatenate((self._adjusted, self._measured))
        information = sparse.diagonal_information(np.concatenate((odometry, self._information[self._used])))
        self._equations = equations = sparse.NormalEquations(self._structure, self._poses, relative, information)
        return equations.solution()

    def channels(self, state: GraphState) -> Tensor:
        """The loops of the last ``look`` for the convolutions ``(batch, blocks, CHANNELS)``.

        Their residuals are spread over the loops, in the frame of each pose; the deviation and support there follow.
        """
        loops, poses, keys = self._judged, self._poses, self._keys
        residuals = loop_residuals(loops.nodes, loops.measured, poses)
        spread, support = spread_over_span(loops.nodes, residuals, self._weights, poses.shape[-2] - 1)
        spread, support = spread[..., keys:, :], support[..., keys:, :]
        of, local = library(poses), se2.rotate(-poses[..., keys:-1, 2], spread[..., :2])
        unit = self._given(self._correction_std)
        # At first, residuals of many standard deviations are usual: the convolutions see their logarithm.
        seen = (
            of.arcsinh(local / unit[:2]),
            of.arcsinh(spread[..., 2:] / unit[2:]),
            of.arcsinh(self._deviation[..., keys:, :] / unit),
            of.log1p(support),
        )
        return self._returned(of.concatenate(seen, axis=-1)).to(state.features)


def judged(gate: RobustLoopGate, loops: Any, poses: Values, step_std: Values, iteration: int) -> tuple[Any, Any]:
    """Gate and information of loops under poses ``(..., poses + 1, 3)``; see ``RobustLoopGate.judged``."""
    expected = odometry_variances(loops.nodes, poses, step_std**2)
    if loops.most_drift is not None:
        expected = library(expected).minimum(expected, loops.most_drift)
    return gate.judged(loops, loop_residuals(loops.nodes, loops.measured, poses), expected, iteration)


def softened(std: Values, stiffness: Values, noise: Values, keys: int) -> Values:
    """Deviations ``(..., poses, 3)`` with which the odometry is believed; the first ``keys`` stay as they are."""
    of = library(std)
    factor = of.exp(3.0 * of.tanh(stiffness / 3.0)) * noise
    believed: Values = of.concatenate((std[..., :keys, :], std[..., keys:, :] * factor), axis=-2)
    return believed


def spread_over_span(nodes: Values, values: Values, weights: Values, steps: int) -> tuple[Values, Values]:
    """Spread a value of each loop evenly over its meta-steps, and average over the loops.

    Args:
        nodes: both ends ``(..., loops, 2)``; values: ``(..., loops, channels)``; weights: ``(..., loops)``.

    Returns:
        Weighted mean of value / length ``(..., steps, channels)`` and sum of weights ``(..., steps, 1)``.
    """
    of, start, end = library(values), nodes[..., 0], nodes[..., 1]
    weights = weights[..., None]
    payload = of.concatenate((values / (end - start)[..., None] * weights, weights), axis=-1)
    if isinstance(nodes, np.ndarray):
        edges = np.zeros((steps + 1, payload.shape[-1]))
        np.add.at(edges, start, payload)
        np.subtract.at(edges, end, payload)
    else:
        edges = payload.new_zeros(payload.shape[0], steps + 1, payload.shape[2])
        index = torch.cat((start, end), dim=1).unsqueeze(-1).expand(-1, -1, payload.shape[2])
        edges = edges.scatter_add(1, index, torch.cat((payload, -payload), dim=1))
    spread = of.cumsum(edges, axis=-2)[..., :-1, :]
    total = spread[..., -1:].clip(0.0)
    return spread[..., :-1] / (total + 1e-3), total
