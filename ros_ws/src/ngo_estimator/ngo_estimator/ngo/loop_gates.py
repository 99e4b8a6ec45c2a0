"""How far loops are off under the current poses, the odometry's drift that explains it, and the trust in them.

``RobustLoopGate`` is the optimizer's learned robust kernel. ``without_contradictions`` is the test before it, which the
odometry alone decides: gates weigh loops one by one, so that hundreds of wrong ones that agree win over the odometry.

All of it takes tensors of a batch, with gradients, or arrays of one trajectory, whose shapes have no batch in front:
hundreds of calls on some hundred rows take torch four times as long as numpy.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.se2 import Values, library
from ngo_estimator.graph.gauss_newton import pick
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.meta_poses import MetaSteps, with_origin

FARTHEST = 40.0
"""Deviations of the odometry between two poses, over x, y and yaw, beyond which a loop contradicts it.

Errors of steps are not independent: true loops of validation mazes are up to 25 deviations off in 2D (one drive of nine
has 40) and 16 in 3D, wrong ones 60 to 130 in the median (docs/notebook.md).
"""

LEAST_STD = 0.01
"""Deviation of a meta-step, m and rad, at least: a registered step says a tenth of that, and is at times that wrong."""

_LEAST_VARIANCE = 1e-12
"""Of the odometry between two poses, m^2 and rad^2, so that none divides by zero."""


def is_single(steps: MetaSteps) -> bool:
    """Whether these are of one trajectory whose optimisation needs no gradient."""
    relative = steps.relative
    return not torch.is_grad_enabled() and relative.shape[0] == 1 and relative.device.type == "cpu"


def chained(relative: Values) -> Values:
    """Poses ``(..., n + 1, 3)``, the origin in front, of relative ones ``(..., n, 3)``: the paper's r2g."""
    return _compiled().chained(relative) if isinstance(relative, np.ndarray) else with_origin(se2.r2g(relative))


def unchained(poses: Values) -> Values:
    """Relative poses ``(..., n, 3)`` between neighbours of ``(..., n + 1, 3)``: the paper's g2r."""
    if isinstance(poses, np.ndarray):
        return _compiled().all_between(poses[:-1], poses[1:])
    return se2.between(poses[:, :-1], poses[:, 1:])


def loop_residuals(nodes: Values, measured: Values, poses: Values) -> Values:
    """Measured minus current relative pose ``(..., loops, 3)``, positions along the axes of the map.

    Args:
        nodes: both poses of each loop ``(..., loops, 2)``.
        measured: the second seen from the first ``(..., loops, 3)``.
        poses: global meta-poses with the origin in front ``(..., poses + 1, 3)``.
    """
    if isinstance(poses, np.ndarray):
        return _compiled().loop_residuals(nodes, measured, poses)
    start, end = pick(poses, nodes[..., 0]), pick(poses, nodes[..., 1])
    xy = se2.rotate(start[..., 2], measured[..., :2]) - (end - start)[..., :2]
    yaw = se2.wrap(start[..., 2] + measured[..., 2] - end[..., 2])
    return torch.cat((xy, yaw.unsqueeze(-1)), dim=-1)


def odometry_variances(nodes: Values, poses: Values, step_variance: Values) -> Values:
    """Variances ``(..., n, 3)`` of poses as seen from earlier ones by odometry alone; all is float64.

    A turn of a meta-step swings the end about the pose behind that step; cross-correlations are dropped.

    Args:
        nodes: the earlier and the later pose ``(..., n, 2)``.
        poses: global meta-poses with the origin in front ``(..., poses + 1, 3)``.
        step_variance: of the relative meta-poses ``(..., poses, 3)``, along the axes of the earlier pose.
    """
    if isinstance(poses, np.ndarray):
        return _compiled().odometry_variances(nodes, poses, step_variance)
    along_x = torch.cos(poses[:, :-1, 2]).square()
    position_x = along_x * step_variance[..., 0] + (1.0 - along_x) * step_variance[..., 1]
    position_y = step_variance[..., :2].sum(-1) - position_x
    turn, at = step_variance[..., 2:], poses[:, 1:, :2]
    lever = turn * at
    terms = torch.cat((torch.stack((position_x, position_y), dim=-1), turn, lever, lever * at), dim=-1)
    # Sums over a loop are differences of prefix sums, of which float32 would leave too few digits.
    prefix = with_origin(terms.cumsum(1))
    along = pick(prefix, nodes[..., 1]) - pick(prefix, nodes[..., 0])
    position, turn, lever, squares = along.split((2, 1, 2, 2), dim=-1)
    end = pick(poses, nodes[..., 1])[..., :2]
    across = end * (end * turn - 2.0 * lever) + squares
    return torch.cat((position + across.flip(-1), turn), dim=-1).clamp(min=0.0)


def _compiled() -> Any:
    # The compiler's library takes 100 MB: only those pay for it that optimise.
    from ngo_estimator.graph import loop_errors

    return loop_errors


def without_contradictions(loops: Loops, steps: MetaSteps) -> Loops:
    """The loops; those that contradict the odometry between their poses are not valid any more.

    What odometry alone says is tested, before anything is corrected: corrections by wrong loops make room for others.
    """
    with torch.no_grad():
        if not is_single(steps):
            held = holds(loops.nodes, loops.measured.double(), steps.relative.double(), steps.std.double())
            return dataclasses.replace(loops, valid=loops.valid & held)
        nodes, measured = loops.nodes[0].numpy(), loops.measured[0].numpy()
        relative, std = (x[0].double().numpy() for x in (steps.relative, steps.std))
        held = torch.from_numpy(holds(nodes, measured, relative, std))
        return dataclasses.replace(loops, valid=loops.valid & held)


def holds(nodes: Values, measured: Values, relative: Values, std: Values) -> Values:
    """Which loops ``(..., loops)`` do not contradict an odometry, ``relative`` and ``std`` ``(..., poses, 3)``."""
    poses = chained(relative)
    variance = odometry_variances(nodes, poses, std.clip(LEAST_STD) ** 2)
    squared = (loop_residuals(nodes, measured, poses) ** 2 / variance.clip(_LEAST_VARIANCE)).sum(-1)
    return squared <= FARTHEST**2


class RobustLoopGate(nn.Module):
    """How much each loop candidate is trusted, from its similarity, length and residual.

    Untrained it is a robust kernel (Geman-McClure) that allows for the drift of the odometry at first, and for less of
    it with each iteration (as in graduated non-convexity, Yang et al. 2020); the network corrects that.
    """

    POSITION_NOISE, HEADING_NOISE = 2.0, 1.0  # deviations of a measurement in units of what the pair head says
    WIDTH = 4.0  # of the kernel: a loop of this squared residual, in deviations, keeps a quarter of its weight
    ANNEALING = 0.25  # share of the drift's variance that is left for the next iteration to allow for

    def __init__(self, hidden: int = 32) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(11, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.head = nn.Linear(hidden, 3)
        noise = torch.tensor([self.POSITION_NOISE, self.HEADING_NOISE]).square()
        self.register_buffer("noise", noise, persistent=False)
        self.register_buffer("components", torch.tensor([2.0, 1.0]), persistent=False)
        merged = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        self.register_buffer("merged", merged, persistent=False)
        self.noise: Tensor
        self.components: Tensor
        self.merged: Tensor  # x, y and yaw to position and heading
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def judged(
        self, loops: Loops, residuals: Values, expected_variance: Values, iteration: int
    ) -> tuple[Values, Values]:
        """Gate ``(..., loops)`` in zero to one, and information ``(..., loops, 3)`` of each loop.

        Args:
            residuals: ``(..., loops, 3)``, float64 like ``expected_variance``; arrays where ``loops`` are.
            expected_variance: what the odometry alone lets the residuals vary ``(..., loops, 3)``.
            iteration: how many iterations came before.
        """
        of, annealing = library(residuals), self.ANNEALING**iteration
        noise, components, merged = (_like(residuals, x) for x in (self.noise, self.components, self.merged))
        # Of position and heading; a position's error has two components.
        variance = of.exp(2.0 * loops.log_scale) * noise
        both = variance * components
        errors, drift = (_times(x, merged) for x in (residuals**2, expected_variance))
        squared = (errors / (both + annealing * drift)).sum(-1)
        numbers = of.stack((of.log1p(squared), of.full_like(squared, annealing)), axis=-1)
        seen = (loops.description, of.log1p(errors / both) / 3.0, numbers)
        belief = self._network(of.concatenate(seen, axis=-1))
        sure = 0.5 + 0.5 * of.tanh(0.5 * loops.logit + 1.0 + 2.0 * belief[..., 0])  # the logistic function
        gate = sure * loops.valid / (1.0 + squared / self.WIDTH) ** 2
        information = gate[..., None] * of.exp(4.0 * of.tanh(belief[..., 1:] / 2.0)) / variance
        return gate, information[..., [0, 0, 1]]

    def _network(self, seen: Values) -> Values:
        """Belief and scales ``(..., loops, 3)`` of what describes loops ``(..., loops, 11)``."""
        linear = [layer for layer in (*self.layers, self.head) if isinstance(layer, nn.Linear)]
        layers = [(_like(seen, of.weight.T), _like(seen, of.bias)) for of in linear]
        weight, bias = layers[0]
        hidden = _times(seen, weight) + bias
        for weight, bias in layers[1:]:
            hidden = hidden.clip(0.0) @ weight + bias  # ReLU
        return hidden


def _like(values: Values, parameter: Tensor) -> Values:
    """A parameter as a tensor, or as an array where ``values`` are one."""
    return parameter.detach().numpy() if isinstance(values, np.ndarray) else parameter


def _times(values: Values, matrix: Values) -> Values:
    """Their product, in the precision of the matrix."""
    if isinstance(values, np.ndarray):
        return values.astype(matrix.dtype) @ matrix
    return values.to(matrix) @ matrix
