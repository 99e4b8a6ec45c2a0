"""Loop closing of one trajectory where nobody asks for a gradient: as ``loop_closing``, compiled, in float64.

Tensors of some hundred rows cost more in calls than in arithmetic. Here an iteration is two calls.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from numba import njit
from torch import Tensor, nn

from ngo_estimator.geometry.planar_motion import chained, wrap
from ngo_estimator.graph.block_cholesky import Array
from ngo_estimator.graph.normal_equations import FactorisedInformation, GraphStructure
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.loop_closing import CHANNELS, OVERLAPS_AFTER, LoopClosing
from ngo_estimator.ngo.loop_gates import RobustLoopGate
from ngo_estimator.ngo.meta_poses import ClosedLoops, GraphState, MetaSteps, OptimizedMetaPoses, Solution
from ngo_estimator.ngo.odometry_consistency import FARTHEST, LEAST_STD, LEAST_VARIANCE

_KERNEL_WIDTH = RobustLoopGate.WIDTH

_LEAST_WEIGHT = 1e-4
"""Of a loop that an earlier solution knew: one of less weight has no share in the equations."""


def without_contradictions(loops: Loops, steps: MetaSteps, which: Array | None = None) -> Loops:
    """As ``odometry_test.without_contradictions``; only the loops of these indices, by default all, are tested."""
    valid = loops.valid.clone()
    which = np.arange(valid.shape[1]) if which is None else which
    if len(which):
        relative, std = steps.relative[0].double().numpy(), steps.std[0].double().numpy()
        start, end, measured = (of[0].numpy() for of in (loops.start, loops.end, loops.measured))
        _test(relative, std, start, end, measured, which, valid[0].numpy())
    return replace(loops, valid=valid)


class _Equations:
    """The loops that have a share in the normal equations of one trajectory, and these.

    Args:
        gate: how much each loop is trusted.
        std: deviations ``(n, 3)`` of the steps between the poses.
        solution: an earlier one, whose belief in the loops that it knew stays; only others are judged.
    """

    def __init__(self, gate: RobustLoopGate, std: Array, loops: Loops, solution: Solution | None = None) -> None:
        linear = [layer for layer in (*gate.layers, gate.head) if isinstance(layer, nn.Linear)]
        self._layers = tuple(_of(layer) for layer in linear)
        self._components = gate.components.double().numpy()
        count = loops.start.shape[1]
        known, weights, information = np.zeros(count, np.bool_), np.zeros(count), np.zeros((count, 3))
        if solution is not None:
            known, weights, information = solution.known, solution.weights, solution.information
        self._used = used = np.flatnonzero(np.where(known, weights >= _LEAST_WEIGHT, loops.valid[0].numpy()))
        self._judged = np.flatnonzero(~known[used])
        self._before = np.maximum(weights, 0.0), np.maximum(information, 0.0)
        self.weights, self._information = (of_all.take(used, axis=0) for of_all in self._before)
        limits = loops.measured.new_full((1, count, 3), torch.inf) if loops.most_drift is None else loops.most_drift
        fields = (loops.similarity, loops.logit, loops.log_scale, loops.spread, loops.log_length)
        record = tuple(field[0].numpy() for field in (loops.start, loops.end, loops.measured, limits, *fields))
        self.nodes, self._measured, self._most_drift, self._constants = _picked(
            record, gate.noise.double().numpy(), used
        )
        """Of the loops that have a share ``(m, ...)``; likewise ``weights``, and residuals behind ``judge``."""
        self._structure = GraphStructure(self.nodes, len(std) + 1, chain=True)

    def judge(self, relative: Array, step_std: Array, iteration: int) -> None:
        """Judge the loops under poses of which these are the relative ones ``(n, 3)``, with their deviations."""
        self.poses, self.residuals = _judge(
            relative, step_std, self.nodes, self._measured, self._most_drift, self._constants, self._judged,
            RobustLoopGate.ANNEALING**iteration, self._components, self._layers, self.weights, self._information,
        )  # fmt: skip

    def of_all(self) -> tuple[Array, Array]:
        """Weights ``(n,)`` and information ``(n, 3)`` of all loops, those included that have no share."""
        weights, information = (of_all.copy() for of_all in self._before)
        weights[self._used], information[self._used] = self.weights, self._information
        return weights, information

    def solve(self, deviation: Array, step_std: Array) -> tuple[Array, FactorisedInformation]:
        """What the steps deviate ``(n, 3)`` after a Gauss-Newton step from the poses of the last ``judge``."""
        structure = self._structure
        diagonal, lower, right = _linearised(
            self.poses, deviation, step_std, self.nodes, self.residuals, self._information, structure.ranks,
            structure.place, structure.blocks.blocks,
        )  # fmt: skip
        equations = FactorisedInformation(structure.blocks, diagonal, lower)
        return _deviated(self.poses, equations.step(right), deviation), equations


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
    ) -> None:
        super().__init__(gate, steps, loops, find_overlaps, odometry_noise, correction_std)
        self._unit = correction_std.double().numpy()
        self._std = steps.std[0].double().numpy()
        self._equations = _Equations(gate, self._std, loops)
        self._solved: FactorisedInformation | None = None
        self._kind = steps.relative.dtype

    @property
    def closed(self) -> ClosedLoops:
        """As ``LoopClosing.closed``, made where it is asked for."""
        if self._solved is None:
            return super().closed
        return _closed(self._loops, self._equations, self._solved, self._kind)

    def look(self, state: GraphState, iteration: int) -> None:
        """As ``LoopClosing.look``."""
        if iteration == OVERLAPS_AFTER and (overlaps := self._find_overlaps(state.poses)) is not None:
            self._loops = self._loops.and_also(overlaps)
            self._equations = _Equations(self._gate, self._std, self._loops)
        relative, step_std = (
            array[0].double().numpy() for array in (state.adjusted.double() + state.deviation, state.step_std)
        )
        self._equations.judge(relative, step_std, iteration)

    def channels(self, state: GraphState) -> Tensor:
        """As ``LoopClosing.channels``."""
        deviation, channels = state.deviation[0].double().numpy(), np.empty((self._steps.blocks, CHANNELS), np.float32)
        of = self._equations
        _channels(of.poses, deviation, of.nodes, of.residuals, of.weights, self._unit, channels)
        return torch.from_numpy(channels).unsqueeze(0)

    def close(self, state: GraphState, stiffness: Tensor) -> GraphState:
        """As ``LoopClosing.close``."""
        step_std = _softened(self._steps, stiffness, self._odometry_noise)
        deviation, equations = self._equations.solve(state.deviation[0].double().numpy(), step_std)
        self._solved, self._kind = equations, state.deviation.dtype
        return replace(
            state,
            deviation=torch.from_numpy(deviation).unsqueeze(0),
            step_std=torch.from_numpy(step_std).unsqueeze(0),
        )


def resumed(
    gate: RobustLoopGate,
    steps: MetaSteps,
    loops: Loops,
    adjusted: Tensor,
    stiffness: Tensor,
    odometry_noise: Tensor,
    solution: Solution,
    last: int,
) -> Iterator[OptimizedMetaPoses]:
    """The result that begins at an earlier solution, of one trajectory.

    New loops are judged as in the first iteration, which allows for the odometry's drift, and then as in the ``last``
    one. Others keep what an annealing of all loops gave them.

    Args:
        adjusted: relative poses ``(1, n, 3)`` with all adjustments; stiffness: of the last iteration.
    """
    step_std = _softened(steps, stiffness, odometry_noise)
    own, relative, std = adjusted[0].double().numpy(), solution.relative[0].numpy(), steps.std[0].double().numpy()
    every = _Equations(gate, std, loops, solution)

    def results() -> Iterator[OptimizedMetaPoses]:
        deviation = relative - own
        deviation[:, 2] = np.remainder(deviation[:, 2] + np.pi, 2.0 * np.pi) - np.pi
        before = std
        for iteration in (0, last):
            every.judge(own + deviation, before, iteration)
            deviation, equations = every.solve(deviation, step_std)
            before = step_std
        poses = torch.from_numpy(own + deviation).unsqueeze(0).to(steps.relative.dtype)
        closed = _closed(loops, every, equations, torch.float64)
        yield OptimizedMetaPoses([poses], torch.from_numpy(step_std).unsqueeze(0), closed)

    return results()


def _closed(loops: Loops, of: _Equations, equations: FactorisedInformation, kind: torch.dtype) -> ClosedLoops:
    weights, information = (torch.from_numpy(values).unsqueeze(0).to(kind) for values in of.of_all())
    return ClosedLoops(loops, weights, information, equations)


def _softened(steps: MetaSteps, stiffness: Tensor, odometry_noise: Tensor) -> Array:
    """Deviations ``(n, 3)`` with which the odometry is believed."""
    step_std = steps.std[0].double().numpy().copy()
    factor = np.exp(3.0 * np.tanh(stiffness.double().numpy() / 3.0))
    step_std[steps.key_frames :] *= (factor[0] if factor.ndim == 3 else factor) * odometry_noise.double().numpy()
    return step_std


def _of(layer: nn.Linear) -> tuple[Array, Array]:
    """Weights, inputs first, and biases of a layer."""
    return np.ascontiguousarray(layer.weight.detach().float().numpy().T), layer.bias.detach().float().numpy()


@njit(cache=True, error_model="numpy")
def _test(relative: Array, std: Array, start: Array, end: Array, measured: Array, which: Array, valid: Array) -> None:
    """Take their validity from loops, of those of the indices ``which``, that contradict the odometry."""
    poses = chained(relative)
    prefix = _drifts(poses, np.maximum(std, LEAST_STD))
    residual, expected = np.empty(3), np.empty(3)
    for k in which:
        nodes = start[k], end[k] + 1
        _residual(poses, nodes, measured[k], residual)
        _expected(poses, prefix, nodes, expected)
        squared = 0.0
        for c in range(3):
            squared += residual[c] ** 2 / max(expected[c], LEAST_VARIANCE)
        valid[k] &= squared <= FARTHEST**2


@njit(cache=True, error_model="numpy")
def _drifts(poses: Array, step_std: Array) -> Array:
    """Sums over the steps before each pose ``(n + 1, 7)``, from which ``odometry_variances`` follow."""
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
    return prefix


@njit(cache=True, error_model="numpy")
def _expected(poses: Array, prefix: Array, nodes: Array | tuple[int, int], expected: Array) -> None:
    """What ``odometry_variances`` expect of a loop ``(3,)``, of the sums of ``_drifts``."""
    a, b = nodes
    x, y = poses[b, 0], poses[b, 1]
    turn = prefix[b, 2] - prefix[a, 2]
    across_x = x * (x * turn - 2.0 * (prefix[b, 3] - prefix[a, 3])) + prefix[b, 5] - prefix[a, 5]
    across_y = y * (y * turn - 2.0 * (prefix[b, 4] - prefix[a, 4])) + prefix[b, 6] - prefix[a, 6]
    expected[0] = max(prefix[b, 0] - prefix[a, 0] + across_y, 0.0)
    expected[1] = max(prefix[b, 1] - prefix[a, 1] + across_x, 0.0)
    expected[2] = max(turn, 0.0)


@njit(cache=True, error_model="numpy")
def _residual(poses: Array, nodes: Array | tuple[int, int], measured: Array, residual: Array) -> None:
    """As ``loop_residuals``, of one loop ``(3,)``."""
    a, b = nodes
    cos, sin = math.cos(poses[a, 2]), math.sin(poses[a, 2])
    residual[0] = poses[a, 0] + cos * measured[0] - sin * measured[1] - poses[b, 0]
    residual[1] = poses[a, 1] + sin * measured[0] + cos * measured[1] - poses[b, 1]
    residual[2] = wrap(poses[a, 2] + measured[2] - poses[b, 2])


@njit(cache=True, error_model="numpy")
def _picked(record: tuple[Array, ...], noise: Array, used: Array) -> tuple[Array, Array, Array, Array]:
    """Of the loops ``used``: nodes, measurements, what limits their drift, and what the gate sees under all poses.

    The last are ``(m, 10)``: ``Loops.description``, that of the length, variances, and logit.
    """
    start, end, measured, limits, similarity, logit, log_scale, spread, log_length = record
    count = len(used)
    nodes, constants = np.empty((count, 2), np.int64), np.empty((count, 10))
    poses, most = np.empty((2, count, 3))
    for k in range(count):
        loop, row = used[k], constants[k]
        nodes[k, 0], nodes[k, 1] = start[loop], end[loop] + 1
        for c in range(3):
            poses[k, c], most[k, c] = measured[loop, c], limits[loop, c]
        row[0], row[1], row[6], row[9] = similarity[loop], logit[loop] / 5.0, log_length[loop] / 3.0, logit[loop]
        for c in range(2):
            row[2 + c], row[4 + c] = log_scale[loop, c], spread[loop, c] - log_scale[loop, c]
            row[7 + c] = math.exp(2.0 * log_scale[loop, c]) * noise[c]
    return nodes, poses, most, constants


@njit(cache=True, error_model="numpy")
def _judge(
    relative: Array,
    step_std: Array,
    nodes: Array,
    measured: Array,
    most_drift: Array,
    constants: Array,
    judged: Array,
    annealing: float,
    components: Array,
    layers: tuple[tuple[Array, Array], ...],
    gates: Array,
    information: Array,
) -> tuple[Array, Array]:
    """Poses ``(n + 1, 3)`` and residuals of all loops; gates and information of the ``judged``, as ``RobustLoopGate``.

    ``components`` ``(2,)`` are those of the gate; ``layers`` are the weights and biases of its layers.
    """
    poses = chained(relative)
    residuals, expected = np.empty((len(nodes), 3)), np.empty(3)
    for k in range(len(nodes)):
        _residual(poses, nodes[k], measured[k], residuals[k])
    if len(judged) == 0:
        return poses, residuals
    prefix = _drifts(poses, step_std)
    (weight_1, bias_1), (weight_2, bias_2), (weight_3, bias_3) = layers
    hidden_1, hidden_2, belief = np.empty_like(bias_1), np.empty_like(bias_2), np.empty_like(bias_3)
    inputs = np.empty(weight_1.shape[0], np.float32)
    for k in judged:
        _expected(poses, prefix, nodes[k], expected)
        for c in range(3):
            expected[c] = min(expected[c], most_drift[k, c])
        errors = (residuals[k, 0] ** 2 + residuals[k, 1] ** 2, residuals[k, 2] ** 2)
        drifts = (annealing * (expected[0] + expected[1]), annealing * expected[2])
        for c in range(7):
            inputs[c] = constants[k, c]
        squared = 0.0
        for c in range(2):
            both = constants[k, 7 + c] * components[c]
            inputs[7 + c] = math.log1p(errors[c] / both) / 3.0
            squared += errors[c] / (both + drifts[c])
        inputs[9], inputs[10] = math.log1p(squared), annealing
        _layer(inputs, weight_1, bias_1, hidden_1, False)
        _layer(hidden_1, weight_2, bias_2, hidden_2, True)
        _layer(hidden_2, weight_3, bias_3, belief, True)
        kernel = (1.0 + squared / _KERNEL_WIDTH) ** 2
        gates[k] = 1.0 / ((1.0 + math.exp(-(constants[k, 9] + 2.0) - 4.0 * belief[0])) * kernel)
        for c in range(2):
            information[k, 1 + c] = gates[k] * math.exp(4.0 * math.tanh(belief[1 + c] / 2.0)) / constants[k, 7 + c]
        information[k, 0] = information[k, 1]
    return poses, residuals


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _layer(inputs: Array, weight: Array, bias: Array, result: Array, rectified: bool) -> None:
    """A linear layer of its inputs, or of those that are positive."""
    result[:] = bias
    for i in range(len(inputs)):
        value = inputs[i]
        if rectified and value <= 0.0:
            continue
        for j in range(len(result)):
            result[j] += value * weight[i, j]


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


@njit(cache=True, error_model="numpy")
def _linearised(
    poses: Array,
    deviation: Array,
    step_std: Array,
    nodes: Array,
    residuals: Array,
    information: Array,
    ranks: Array,
    place: Array,
    blocks: int,
) -> tuple[Array, Array, Array]:
    """The normal equations, as ``GraphStructure.empty`` has their blocks; ranks and places of the steps come first."""
    steps = len(deviation)
    diagonal, lower, right = np.zeros((steps, 3, 3)), np.zeros((blocks, 3, 3)), np.zeros((steps, 3, 1))
    _add_chain(poses, deviation, step_std, ranks, place, diagonal, lower, right)
    _add_loops(poses, nodes, residuals, information, ranks[steps:], place[steps:], diagonal, lower, right)
    return diagonal, lower, right


@njit(cache=True)
def _deviated(poses: Array, change: Array, before: Array) -> Array:
    """Deviations ``(n, 3)`` with what a change of the poses ``(n + 1, 3)`` changes in the steps between them."""
    deviation = before.copy()
    for k in range(len(deviation)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        x, y = poses[k + 1, 0] - poses[k, 0], poses[k + 1, 1] - poses[k, 1]
        yaw = poses[k, 2] + change[k, 2]
        new_cos, new_sin = math.cos(yaw), math.sin(yaw)
        new_x, new_y = x + change[k + 1, 0] - change[k, 0], y + change[k + 1, 1] - change[k, 1]
        deviation[k, 0] += new_cos * new_x + new_sin * new_y - cos * x - sin * y
        deviation[k, 1] += new_cos * new_y - new_sin * new_x - cos * y + sin * x
        deviation[k, 2] += wrap(change[k + 1, 2] - change[k, 2])
    return deviation
