"""Loop closing of one trajectory where nobody asks for a gradient: as ``loop_closing``, compiled, in float64.

Tensors of some hundred rows cost more in calls than in arithmetic. Here an iteration is two calls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numba import njit
from torch import Tensor, nn

from ngo_estimator.geometry.planar_motion import chained, wrap
from ngo_estimator.optimizer.block_cholesky import Array
from ngo_estimator.optimizer.loop_closing import CHANNELS, OVERLAPS_AFTER, LoopClosing
from ngo_estimator.optimizer.loop_closure import Loops
from ngo_estimator.optimizer.loop_gates import RobustLoopGate
from ngo_estimator.optimizer.meta_poses import ClosedLoops, GraphState, MetaSteps, Solution
from ngo_estimator.optimizer.normal_equations import FactorisedInformation, GraphStructure
from ngo_estimator.optimizer.odometry_test import FARTHEST, LEAST_STD, LEAST_VARIANCE

_GATE_INPUTS = 11
_KERNEL_WIDTH = RobustLoopGate.WIDTH
_ALL = slice(None)


_LEAST_WEIGHT = 1e-4
"""Of a loop that an earlier solution knew: one of less weight has no share in the equations."""


def without_contradictions(loops: Loops, steps: MetaSteps, which: Array | slice = _ALL) -> Loops:
    """As ``odometry_test.without_contradictions``; only the loops of these indices are tested."""
    relative, std = steps.relative[0].double().numpy(), steps.std[0].double().numpy()
    nodes, measured = loops.nodes[0].numpy()[which], loops.measured[0].double().numpy()[which]
    residuals, variance = np.empty((2, len(nodes), 3))
    unlimited = np.full((len(nodes), 3), np.inf)
    _residuals(chained(relative), np.maximum(std, LEAST_STD), nodes, measured, unlimited, residuals, variance)
    valid = loops.valid.clone()
    valid[0].numpy()[which] &= (np.square(residuals) / np.maximum(variance, LEAST_VARIANCE)).sum(1) <= FARTHEST**2
    return replace(loops, valid=valid)


class CompiledClosing(LoopClosing):
    """As ``LoopClosing``, for a single trajectory on the CPU, without gradients; arguments as there."""

    def __init__(
        self,
        gate: RobustLoopGate,
        steps: MetaSteps,
        loops: Loops,
        find_overlaps: Callable[[Tensor], Loops | None],
        odometry_noise: Tensor,
        correction_std: Tensor,
        solution: Solution | None = None,
    ) -> None:
        super().__init__(gate, steps, loops, find_overlaps, odometry_noise, correction_std, solution)
        self._layers, self._head = [_of(layer) for layer in gate.layers if isinstance(layer, nn.Linear)], _of(gate.head)
        self._noise_2 = np.stack((gate.noise.double().numpy(), gate.components.double().numpy()))
        self._noise, self._unit = odometry_noise.double().numpy(), correction_std.double().numpy()
        self._std = steps.std[0].double().numpy()
        self._take(loops)

    def _take(self, loops: Loops) -> None:
        self._loops = loops
        self._used: Array | slice = _ALL
        """Which loops are in the equations, and which of these are judged: without a solution, all of them."""
        self._judged: Array | slice = _ALL
        if self._solution is not None:
            known = self._solution.known
            self._used = np.flatnonzero(~known | (self._solution.weights >= _LEAST_WEIGHT))
            self._judged = np.flatnonzero(~known[self._used])
        nodes, blocks = loops.nodes[0].numpy()[self._used], len(self._std)
        self._structure = GraphStructure(nodes, blocks + 1, chain=True)
        self._nodes = nodes
        self._measured = loops.measured[0].double().numpy()[self._used]
        if self._solution is not None:
            self._weights, self._information = self._solution.weights[self._used], self._solution.information[self._used]
        else:
            self._weights, self._information = np.empty(len(nodes)), np.empty((len(nodes), 3))
        limits = loops.most_drift
        self._most_drift = (
            np.full((len(nodes), 3), np.inf) if limits is None else limits[0].double().numpy()[self._used]
        )
        constants = (
            loops.description[0],
            loops.log_length[0].unsqueeze(-1),
            loops.log_scale[0],
            loops.logit[0].unsqueeze(-1),
            loops.valid[0].unsqueeze(-1),
        )
        self._constants = torch.cat([part.double() for part in constants], dim=-1).numpy()[self._used][self._judged]

    def look(self, state: GraphState, iteration: int) -> None:
        """As ``LoopClosing.look``."""
        if iteration == OVERLAPS_AFTER and (overlaps := self._find_overlaps(state.poses)) is not None:
            self._take(self._loops.and_also(overlaps))
        arrays = (state.adjusted, state.deviation, state.step_std)
        adjusted, deviation, step_std = (array[0].double().numpy() for array in arrays)
        self._residuals, expected = np.empty((2, len(self._nodes), 3))
        self._poses = chained(adjusted + deviation)
        _residuals(self._poses, step_std, self._nodes, self._measured, self._most_drift, self._residuals, expected)
        annealing = RobustLoopGate.ANNEALING**iteration
        count = len(self._constants)
        inputs, squared = np.empty((count, _GATE_INPUTS), np.float32), np.empty(count)
        residuals, expected = self._residuals[self._judged], expected[self._judged]
        _gate_inputs(self._constants, residuals, expected, annealing, self._noise_2, inputs, squared)
        hidden = inputs
        for weight, bias in self._layers:
            hidden = np.maximum(hidden @ weight + bias, 0.0)
        belief = hidden @ self._head[0] + self._head[1]
        weights, information = np.empty(count), np.empty((count, 3))
        _gates(self._constants, belief, squared, self._noise_2, weights, information)
        self._weights[self._judged], self._information[self._judged] = weights, information

    def channels(self, state: GraphState) -> Tensor:
        """As ``LoopClosing.channels``."""
        deviation, channels = state.deviation[0].double().numpy(), np.empty((self._steps.blocks, CHANNELS), np.float32)
        _channels(self._poses, deviation, self._nodes, self._residuals, self._weights, self._unit, channels)
        return torch.from_numpy(channels).unsqueeze(0)

    def close(self, state: GraphState, stiffness: Tensor) -> GraphState:
        """As ``LoopClosing.close``."""
        keys = self._steps.key_frames
        step_std, deviation = self._std.copy(), state.deviation[0].double().numpy().copy()
        factor = np.exp(3.0 * np.tanh(stiffness.double().numpy() / 3.0))
        step_std[keys:] *= (factor[0] if factor.ndim == 3 else factor) * self._noise
        structure = self._structure
        diagonal, lower, right = structure.empty()
        steps = len(self._std)
        chain, loops = ((of[:steps], of[steps:]) for of in (structure.ranks, structure.place))
        _add_chain(self._poses, deviation, step_std, chain[0], loops[0], diagonal, lower, right)
        _add_loops(
            self._poses, self._nodes, self._residuals, self._information, chain[1], loops[1], diagonal, lower, right
        )  # fmt: skip
        equations = FactorisedInformation(structure.blocks, diagonal, lower)
        _deviate(self._poses, equations.step(right), deviation)
        kind = state.deviation.dtype
        weights, information = (torch.from_numpy(values).unsqueeze(0).to(kind) for values in self._of_all_loops())
        self._closed = ClosedLoops(self._loops, weights, information, equations)
        return replace(
            state,
            deviation=torch.from_numpy(deviation).unsqueeze(0),
            step_std=torch.from_numpy(step_std).unsqueeze(0),
        )

    def _of_all_loops(self) -> tuple[Array, Array]:
        """Weights ``(n,)`` and information ``(n, 3)`` of all loops, those without a share in the equations included."""
        if self._solution is None:
            return self._weights.copy(), self._information.copy()
        weights, information = self._solution.weights.copy(), self._solution.information.copy()
        weights[self._used], information[self._used] = self._weights, self._information
        return weights, information


def _of(layer: nn.Linear) -> tuple[Array, Array]:
    """Weights, inputs first, and biases of a layer."""
    return layer.weight.detach().float().numpy().T.copy(), layer.bias.detach().float().numpy()


@njit(cache=True, error_model="numpy")
def _residuals(
    poses: Array, step_std: Array, nodes: Array, measured: Array, most_drift: Array, residuals: Array, expected: Array
) -> None:
    """As ``loop_residuals`` and ``odometry_variances``, limited by ``most_drift``."""
    prefix = np.zeros((len(poses), 7))
    for k in range(len(step_std)):
        along_x = math.cos(poses[k, 2]) ** 2
        first, second, turn = step_std[k, 0] ** 2, step_std[k, 1] ** 2, step_std[k, 2] ** 2
        x, y = poses[k + 1, 0], poses[k + 1, 1]
        in_x = along_x * first + (1.0 - along_x) * second
        prefix[k + 1, 0] = prefix[k, 0] + in_x
        prefix[k + 1, 1] = prefix[k, 1] + first + second - in_x
        prefix[k + 1, 2] = prefix[k, 2] + turn
        prefix[k + 1, 3] = prefix[k, 3] + turn * x
        prefix[k + 1, 4] = prefix[k, 4] + turn * y
        prefix[k + 1, 5] = prefix[k, 5] + turn * x * x
        prefix[k + 1, 6] = prefix[k, 6] + turn * y * y
    for k in range(len(nodes)):
        a, b = nodes[k]
        cos, sin = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        x, y = poses[b, 0], poses[b, 1]
        residuals[k, 0] = poses[a, 0] + cos * measured[k, 0] - sin * measured[k, 1] - x
        residuals[k, 1] = poses[a, 1] + sin * measured[k, 0] + cos * measured[k, 1] - y
        residuals[k, 2] = wrap(poses[a, 2] + measured[k, 2] - poses[b, 2])
        turn = prefix[b, 2] - prefix[a, 2]
        across_x = x * (x * turn - 2.0 * (prefix[b, 3] - prefix[a, 3])) + prefix[b, 5] - prefix[a, 5]
        across_y = y * (y * turn - 2.0 * (prefix[b, 4] - prefix[a, 4])) + prefix[b, 6] - prefix[a, 6]
        expected[k, 0] = min(max(prefix[b, 0] - prefix[a, 0] + across_y, 0.0), most_drift[k, 0])
        expected[k, 1] = min(max(prefix[b, 1] - prefix[a, 1] + across_x, 0.0), most_drift[k, 1])
        expected[k, 2] = min(max(turn, 0.0), most_drift[k, 2])


@njit(cache=True, error_model="numpy")
def _gate_inputs(
    constants: Array, residuals: Array, expected: Array, annealing: float, noise: Array, inputs: Array, squared: Array
) -> None:
    """What ``RobustLoopGate`` sees ``(n, 11)``, and squared residuals ``(n,)`` in deviations.

    ``constants`` ``(n, 11)``: description, logarithms of length and scales, logit, valid; ``noise`` ``(2, 2)``: that of
    the gate, and its components.
    """
    for k in range(len(constants)):
        errors = (residuals[k, 0] ** 2 + residuals[k, 1] ** 2, residuals[k, 2] ** 2)
        drifts = (annealing * (expected[k, 0] + expected[k, 1]), annealing * expected[k, 2])
        for c in range(6):
            inputs[k, c] = constants[k, c]
        inputs[k, 6] = constants[k, 6] / 3.0
        total = 0.0
        for c in range(2):
            both = math.exp(2.0 * constants[k, 7 + c]) * noise[0, c] * noise[1, c]
            inputs[k, 7 + c] = math.log1p(errors[c] / both) / 3.0
            total += errors[c] / (both + drifts[c])
        squared[k], inputs[k, 9], inputs[k, 10] = total, math.log1p(total), annealing


@njit(cache=True, error_model="numpy")
def _gates(constants: Array, belief: Array, squared: Array, noise: Array, gates: Array, information: Array) -> None:
    """Gates ``(n,)`` and information ``(n, 3)`` of what the layers of ``RobustLoopGate`` say ``(n, 3)``."""
    for k in range(len(constants)):
        kernel = (1.0 + squared[k] / _KERNEL_WIDTH) ** 2
        gate = constants[k, 10] / ((1.0 + math.exp(-(constants[k, 9] + 2.0) - 4.0 * belief[k, 0])) * kernel)
        gates[k] = gate
        for c in range(2):
            variance = math.exp(2.0 * constants[k, 7 + c]) * noise[0, c]
            information[k, 1 + c] = gate * math.exp(4.0 * math.tanh(belief[k, 1 + c] / 2.0)) / variance
        information[k, 0] = information[k, 1]


@njit(cache=True, error_model="numpy")
def _channels(
    poses: Array, deviation: Array, nodes: Array, residuals: Array, weights: Array, unit: Array, channels: Array
) -> None:
    """The loops for the convolutions: as ``spread_over_span`` and ``LoopClosing`` make them."""
    edges = np.zeros((len(poses), 4))
    for k in range(len(nodes)):
        a, b = nodes[k]
        for c in range(4):
            value = weights[k] if c == 3 else weights[k] * residuals[k, c] / (b - a)
            edges[a, c] += value
            edges[b, c] -= value
    keys = len(deviation) - len(channels)
    total = np.zeros(4)
    for k in range(len(deviation)):
        total += edges[k]
        if k < keys:
            continue
        support = max(total[3], 0.0)
        x, y, yaw = total[0] / (support + 1e-3), total[1] / (support + 1e-3), total[2] / (support + 1e-3)
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        row = channels[k - keys]
        row[0] = math.asinh((cos * x + sin * y) / unit[0])
        row[1] = math.asinh((cos * y - sin * x) / unit[1])
        row[2] = math.asinh(yaw / unit[2])
        for c in range(3):
            row[3 + c] = math.asinh(deviation[k, c] / unit[c])
        row[6] = math.log1p(support)


@njit(cache=True, error_model="numpy")
def _add_chain(
    poses: Array,
    deviation: Array,
    step_std: Array,
    ranks: Array,
    place: Array,
    diagonal: Array,
    lower: Array,
    right: Array,
) -> None:
    """Add the factors of ``chain_factors``."""
    for k in range(len(deviation)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        x, y = poses[k + 1, 0] - poses[k, 0], poses[k + 1, 1] - poses[k, 1]
        first, second, turn = 1.0 / step_std[k, 0] ** 2, 1.0 / step_std[k, 1] ** 2, 1.0 / step_std[k, 2] ** 2
        # Along the axes of the map, of the later pose: information, pull, and what the earlier heading does.
        xx, xy = cos * cos * first + sin * sin * second, cos * sin * (first - second)
        yy = sin * sin * first + cos * cos * second
        across, along = cos * y - sin * x, -cos * x - sin * y
        pulls = (-first * deviation[k, 0], -second * deviation[k, 1], -turn * deviation[k, 2])
        pull = (cos * pulls[0] - sin * pulls[1], sin * pulls[0] + cos * pulls[1], pulls[2])
        lever = (cos * first * across - sin * second * along, sin * first * across + cos * second * along)
        at, to, between = ranks[k, 0], ranks[k, 1], place[k]
        for node, sign in ((at, -1.0), (to, 1.0)):
            if node < 0:
                continue
            for c in range(3):
                right[node, c, 0] += sign * pull[c]
            diagonal[node, 0, 0] += xx
            diagonal[node, 0, 1] += xy
            diagonal[node, 1, 0] += xy
            diagonal[node, 1, 1] += yy
            diagonal[node, 2, 2] += turn
        if at >= 0:
            right[at, 2, 0] += across * pulls[0] + along * pulls[1]
            diagonal[at, 2, 2] += first * across**2 + second * along**2
            for c in range(2):
                diagonal[at, 2, c] -= lever[c]
                diagonal[at, c, 2] -= lever[c]
        if between >= 0:
            lower[between, 0, 0] -= xx
            lower[between, 0, 1] -= xy
            lower[between, 1, 0] -= xy
            lower[between, 1, 1] -= yy
            lower[between, 2, 2] -= turn
            for c in range(2):
                if at > to:
                    lower[between, 2, c] += lever[c]
                else:
                    lower[between, c, 2] += lever[c]


@njit(cache=True, error_model="numpy")
def _add_loops(
    poses: Array,
    nodes: Array,
    residuals: Array,
    information: Array,
    ranks: Array,
    place: Array,
    diagonal: Array,
    lower: Array,
    right: Array,
) -> None:
    """Add the factors of ``pair_factors``."""
    for k in range(len(nodes)):
        a, b = nodes[k]
        # What the start's heading does to the residual.
        lever = (poses[b, 1] - poses[a, 1], poses[a, 0] - poses[b, 0], -1.0)
        at, to, between = ranks[k, 0], ranks[k, 1], place[k]
        for c in range(3):
            weight = information[k, c]
            pull, moment = weight * residuals[k, c], weight * lever[c]
            if at >= 0:
                right[at, 2, 0] += moment * residuals[k, c]
                diagonal[at, 2, 2] += moment * lever[c]
                if c < 2:
                    right[at, c, 0] -= pull
                    diagonal[at, c, c] += weight
                    diagonal[at, 2, c] -= moment
                    diagonal[at, c, 2] -= moment
            if to >= 0:
                right[to, c, 0] += pull
                diagonal[to, c, c] += weight
            if between >= 0:
                if c < 2:
                    lower[between, c, c] -= weight
                if at > to:
                    lower[between, 2, c] += moment
                else:
                    lower[between, c, 2] += moment


@njit(cache=True)
def _deviate(poses: Array, change: Array, deviation: Array) -> None:
    """Add to deviations ``(n, 3)`` what a change of the poses ``(n + 1, 3)`` changes in the steps between them."""
    for k in range(len(deviation)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        x, y = poses[k + 1, 0] - poses[k, 0], poses[k + 1, 1] - poses[k, 1]
        yaw = poses[k, 2] + change[k, 2]
        new_cos, new_sin = math.cos(yaw), math.sin(yaw)
        new_x, new_y = x + change[k + 1, 0] - change[k, 0], y + change[k + 1, 1] - change[k, 1]
        deviation[k, 0] += new_cos * new_x + new_sin * new_y - cos * x - sin * y
        deviation[k, 1] += new_cos * new_y - new_sin * new_x - cos * y + sin * x
        deviation[k, 2] += wrap(change[k + 1, 2] - change[k, 2])
