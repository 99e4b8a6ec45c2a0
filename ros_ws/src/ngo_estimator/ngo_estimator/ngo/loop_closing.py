"""Loop closing: each iteration judges the loops under the current poses, and closes them by a Gauss-Newton step.

Not in the paper, whose attention has to learn loop closures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.graph.gauss_newton import chain_factors, gauss_newton_step, pair_factors, step_information
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.loop_gates import RobustLoopGate
from ngo_estimator.ngo.loop_residuals import loop_residuals, odometry_variances, spread_over_span
from ngo_estimator.ngo.meta_poses import ClosedLoops, GraphState, MetaSteps

OVERLAPS_AFTER = 2
"""Iterations after which poses are good enough to look for frames that see the same walls."""

CHANNELS = 7
"""Channels in which the convolutions see the loops: spread residual, deviation (three each) and support."""


@dataclass(frozen=True)
class _GatedLoops:
    """The loops under the poses of one iteration ``(batch, poses + 1, 3)``, origin in front.

    ``residuals`` ``(batch, loops, 3)``; ``weights`` ``(batch, loops)``; ``information`` ``(batch, loops, 3)``.
    """

    poses: Tensor
    loops: Loops
    residuals: Tensor
    weights: Tensor
    information: Tensor


class NoLoopClosing:
    """Stands for ``LoopClosing`` in an optimizer without loops."""

    closed = None

    def look(self, state: GraphState, iteration: int) -> None:
        """Nothing."""

    def channels(self, state: GraphState) -> Tensor:
        """No channels."""
        return state.features[..., :0]

    def close(self, state: GraphState, stiffness: Tensor) -> GraphState:
        """The state as it is."""
        return state


class LoopClosing:
    """Closes the loops of one optimisation, iteration by iteration, so that gradients can be asked for.

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
        self._gate, self._steps, self._loops, self._find_overlaps = gate, steps, loops, find_overlaps
        self._odometry_noise, self._correction_std = odometry_noise, correction_std
        self._gated: _GatedLoops
        self._closed: ClosedLoops | None = None

    @property
    def closed(self) -> ClosedLoops:
        """The loops of the last ``close``; raises ``RuntimeError`` before it."""
        if self._closed is None:
            raise RuntimeError("no iteration has closed loops yet; expected look() and close() before")
        return self._closed

    def look(self, state: GraphState, iteration: int) -> None:
        """Judge the loops under the current poses; the third iteration adds overlaps to them."""
        if iteration == OVERLAPS_AFTER and (overlaps := self._find_overlaps(state.poses)) is not None:
            self._loops = self._loops.and_also(overlaps)
        loops, poses = self._loops, state.poses
        residuals = loop_residuals(loops, poses)
        expected = odometry_variances(loops.start, loops.end + 1, poses, state.step_std.square()).to(poses.dtype)
        if loops.most_drift is not None:
            expected = torch.minimum(expected, loops.most_drift)
        weights, information = self._gate(loops, residuals, expected, iteration)
        self._gated = _GatedLoops(poses, loops, residuals, weights, information)

    def close(self, state: GraphState, stiffness: Tensor) -> GraphState:
        """Take a Gauss-Newton step from the poses of the last ``look``, so that the gated loops close.

        Args:
            stiffness: ``(batch, blocks, 3)`` or ``(3,)``: logarithm of a factor of the odometry's deviations, which is
                then limited to -3 to 3.
        """
        gated, keys, base_std = self._gated, self._steps.key_frames, self._steps.std
        own = base_std[:, keys:] * torch.exp(3.0 * torch.tanh(stiffness / 3.0)) * self._odometry_noise
        step_std = torch.cat((base_std[:, :keys], own), dim=1)
        # Sums over hundreds of poses need more digits than float32 has.
        poses = gated.poses.double()
        odometry = step_information(step_std.double())
        factors = [
            chain_factors(poses, state.deviation.double(), odometry),
            pair_factors(gated.loops.nodes, poses, gated.residuals.double(), gated.information.double()),
        ]
        change = gauss_newton_step(factors, poses.shape[1])
        after, before = se2.g2r(torch.cat((poses + change, poses))[:, 1:]).chunk(2)
        deviation = state.deviation + se2.wrapped(after - before).to(state.deviation.dtype)
        self._closed = ClosedLoops(gated.loops, gated.weights, gated.information, None)
        return replace(state, deviation=deviation, step_std=step_std)

    def channels(self, state: GraphState) -> Tensor:
        """The loops of the last ``look`` for the convolutions ``(batch, blocks, CHANNELS)``.

        Their residuals are spread over the loops, in the frame of each pose; the deviation and support there follow.
        """
        gated, keys, poses = self._gated, self._steps.key_frames, state.poses
        spread, support = spread_over_span(gated.loops, gated.residuals, gated.weights, state.adjusted.shape[1])
        spread, support = spread[:, keys:], support[:, keys:]
        local = torch.cat((se2.rotate(-poses[:, keys:-1, 2], spread[..., :2]), spread[..., 2:]), dim=-1)
        bent = torch.cat((local, state.deviation[:, keys:]), dim=-1)
        # At first, residuals of many standard deviations are usual: the convolutions see their logarithm.
        return torch.cat((torch.asinh(bent / self._correction_std.repeat(2)), torch.log1p(support)), dim=-1)
