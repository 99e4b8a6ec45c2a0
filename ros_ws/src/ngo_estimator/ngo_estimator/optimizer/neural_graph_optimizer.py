"""The Neural Graph Optimizer (paper, section "Neural Graph Optimization"), with and without loop closures."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from ngo_estimator.geometry import se2
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.networks.pose_aggregation import (
    PoseAggregation,
    PoseAggregationConfig,
    block_variances,
    frame_poses,
    poses_in_blocks,
)
from ngo_estimator.optimizer.compass_closure import CompassFixes, CompassGate, compass_factors
from ngo_estimator.optimizer.gauss_newton import chain_factors, gauss_newton_step, node_covariance, pair_factors
from ngo_estimator.optimizer.loop_closure import (
    Loops,
    LoopSearch,
    find_loops,
    loop_residuals,
    odometry_variances,
    spread_over_span,
)
from ngo_estimator.optimizer.loop_gates import RobustLoopGate
from ngo_estimator.optimizer.normal_equations import GraphStructure, NormalEquations
from ngo_estimator.optimizer.overlaps import find_overlaps
from ngo_estimator.optimizer.registered_odometry import registered_steps

OVERLAPS_AFTER = 2
"""Iterations after which poses are good enough to look for frames that see the same walls."""

_ODOMETRY_NOISE = (2.0, 2.0, 1.0)
"""Deviations of a relative meta-pose, before anything is learned, in units of what its steps' deviations make it."""


@dataclass(frozen=True)
class NeuralGraphOptimizerConfig:
    """What the optimizer is made of; ``paper_form`` gives the paper's.

    ``iterations`` attend-optimise iterations share their weights. ``attention`` is ``softmax``, or ``sum``, the
    paper's C / sum(C). ``dilations`` holds one number a convolution; with ``residual`` each is added to its input, and
    normalised over its channels. With ``loops`` every iteration sees the residuals of the loop candidates under the
    current poses and takes a Gauss-Newton step that reduces them; ``search`` says which candidates there are, and how
    many more are looked for under the poses after ``OVERLAPS_AFTER`` iterations. Without
    ``network`` this step is all there is: no attention and no convolutions, one learned factor for the odometry's
    deviations. With a ``smoother``, meta-poses are made of odometry that it has smoothed.
    ``correction_std`` (m, m, rad), the typical error of a relative meta-pose as the local odometry has it, is the unit
    of the adjustments.
    ``covariance_scale`` multiplies the covariance of a pose: how far errors were beyond it on validation.
    """

    aggregation: PoseAggregationConfig
    iterations: int = 5
    attention: str = "softmax"
    dilations: tuple[int, ...] = (1, 1, 2, 4, 8, 4, 2, 1, 1)
    residual: bool = True
    loops: bool = True
    network: bool = True
    compass: bool = False
    smoother: SmootherConfig | None = None
    search: LoopSearch = field(default_factory=LoopSearch)
    correction_std: tuple[float, float, float] = (0.05, 0.05, 0.02)
    covariance_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.attention not in ("softmax", "sum"):
            raise ValueError(f"attention is {self.attention!r}; expected 'softmax' or 'sum'")
        if self.iterations < 1 or not self.dilations or min(self.dilations) < 1:
            raise ValueError(
                f"iterations, dilations are {self.iterations}, {self.dilations}; expected at least 1, and a positive "
                "number for each convolution"
            )
        if not (self.loops or self.network) or (self.compass and not self.loops):
            raise ValueError(
                f"loops, network, compass are {self.loops}, {self.network}, {self.compass}; expected loops or a "
                "network, and a compass with loops only"
            )
        if self.smoother is not None and self.smoother.motion_feature_size != self.aggregation.motion_feature_size:
            raise ValueError(
                f"the smoother takes {self.smoother.motion_feature_size} motion features; expected "
                f"{self.aggregation.motion_feature_size}, as the aggregation"
            )
        if min(self.correction_std) <= 0.0:
            raise ValueError(f"correction_std is {self.correction_std}; expected three positive numbers")
        if not 0.0 < self.covariance_scale < math.inf:
            raise ValueError(f"covariance_scale is {self.covariance_scale}; expected a positive number")

    @property
    def context(self) -> int:
        """Blocks on either side that a block's relative meta-pose and feature depend on."""
        reach = 0 if self.smoother is None else self.smoother.reach
        reach += self.aggregation.reach if self.network else 0
        return math.ceil(reach / self.aggregation.block)

    @property
    def registrations(self) -> int:
        """Steps in which ranges are registered, 0 where they are not."""
        return self.search.registrations if self.loops else 0

    @classmethod
    def paper_form(cls, aggregation: PoseAggregationConfig, **changes: object) -> "NeuralGraphOptimizerConfig":
        """Nine plain convolutions of kernel 3 over features and attention; no place codes and no loops."""
        form: dict[str, object] = {
            "attention": "sum",
            "dilations": (1,) * 9,
            "residual": False,
            "loops": False,
        }
        return cls(aggregation=aggregation, **{**form, **changes})  # type: ignore[arg-type]


@dataclass(frozen=True)
class MetaSteps:
    """Relative meta-poses as the local odometry has them, smoothed where the optimizer does so.

    ``relative`` ``(batch, poses, 3)`` and ``std``, their standard deviations along the axes of the pose before. The
    last ``blocks`` of them are blocks of steps, with ``features`` ``(batch, blocks, width)`` where the optimizer has a
    network; those in front, if any, lead from the origin to the first block and may stand for many steps each.
    ``in_blocks`` ``(batch, blocks, block, 3)`` are the poses within blocks, without which no overlaps are looked for.
    """

    relative: Tensor
    std: Tensor
    features: Tensor | None
    blocks: int
    in_blocks: Tensor | None = None


@dataclass(frozen=True)
class OptimizedMetaPoses:
    """What the optimizer gives for a batch of meta-steps.

    ``meta_relative``: one ``(batch, poses, 3)`` for each iteration, first to last. ``loops`` with ``loop_weights``
    ``(batch, loops)`` of the last iteration, zero to one. ``loop_information`` ``(batch, loops, 3)`` and ``step_std``
    ``(batch, poses, 3)``: the belief in the loops and in the relative meta-poses. ``equations``: those of the last
    Gauss-Newton step, where no gradient was asked for.
    """

    meta_relative: list[Tensor]
    loops: Loops | None
    loop_weights: Tensor | None
    loop_information: Tensor | None
    step_std: Tensor
    equations: NormalEquations | None

    def end_covariance(self) -> Tensor:
        """Covariance ``(batch, 3, 3)`` of the last meta-pose in the map (x, y, yaw), float64."""
        if self.equations is not None:
            # Linearised before the last step, which was small, and all else alike.
            return torch.from_numpy(self.equations.covariance([self.step_std.shape[1]])).unsqueeze(0)
        poses = _with_origin(se2.r2g(self.meta_relative[-1].double()))
        step_std = self.step_std.double()
        factors = [chain_factors(poses, torch.zeros_like(step_std), step_std)]
        if self.loops is not None and self.loop_information is not None:
            residual = torch.zeros_like(self.loop_information)
            factors.append(pair_factors(self.loops.nodes, poses, residual, self.loop_information))
        return node_covariance(factors, poses.shape[1], poses.shape[1] - 1)


@dataclass(frozen=True)
class OptimizedTrajectory(OptimizedMetaPoses):
    """The same with ``poses`` ``(batch, steps, 3)``: corrected global poses of all frames after the origin."""

    poses: Tensor


class NeuralGraphOptimizer(nn.Module):
    """Redistributes the error of a trajectory by iterated attention and temporal convolution.

    Each iteration attends over all meta-poses, passes features and attention through the convolutions, and adds gated
    adjustments to the relative meta-poses. With ``loops`` the convolutions also see the loops' residuals, spread over
    their spans, and say how far each meta-step may bend; a Gauss-Newton step then closes the gated loops.
    A freshly initialised optimizer returns its input exactly, or with loops what a robust pose graph makes of it.
    Unlike in the paper, features, adjustments and gates are read from the last convolution by three layers of kernel 1,
    and only the features pass through a ReLU.
    """

    def __init__(self, config: NeuralGraphOptimizerConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("correction_std", torch.tensor(config.correction_std), persistent=False)
        self.correction_std: Tensor
        if config.smoother is not None:
            self.smoother = OdometrySmoother(config.smoother)
        if config.network:
            self._build_network(config)
        if config.loops:
            self.register_buffer("odometry_noise", torch.tensor(_ODOMETRY_NOISE), persistent=False)
            self.odometry_noise: Tensor
            self.loop_gate = RobustLoopGate()
            if not config.network:
                self.log_scale = nn.Parameter(torch.zeros(3))
            if config.compass:
                self.compass_gate = CompassGate()

    def _build_network(self, config: NeuralGraphOptimizerConfig) -> None:
        width = config.aggregation.width
        self.aggregation = PoseAggregation(config.aggregation)
        self.query = nn.Linear(width, width)
        channels = 2 * width + (7 if config.loops else 0)
        self.convolutions, self.norms = nn.ModuleList(), nn.ModuleList()
        for dilation in config.dilations:
            self.convolutions.append(nn.Conv1d(channels, width, 3, 1, dilation, dilation))
            self.norms.append(nn.LayerNorm(width) if config.residual else nn.Identity())
            channels = width
        self.feature = nn.Conv1d(width, width, 1)
        self.gate = nn.Conv1d(width, 1, 1)
        self.adjustment = _zero(nn.Conv1d(width, 3, 1))
        if config.loops:
            self.place_gain = nn.Parameter(torch.tensor(0.0))
            self.stiffness = _zero(nn.Conv1d(width, 3, 1))

    def with_smoother(self, smoother: OdometrySmoother | None) -> "NeuralGraphOptimizer":
        """The same optimizer with a copy of another smoother, or without any."""
        config = replace(self.config, smoother=None if smoother is None else smoother.config)
        values = {name: value for name, value in self.state_dict().items() if not name.startswith("smoother.")}
        if smoother is not None:
            values |= {f"smoother.{name}": value for name, value in smoother.state_dict().items()}
        changed = NeuralGraphOptimizer(config)
        changed.load_state_dict(values)
        return changed

    def with_registrations(self, registrations: int) -> "NeuralGraphOptimizer":
        """The same optimizer with another number of steps in which each loop is registered; with 0 without overlaps."""
        overlaps = self.config.search.overlaps if registrations else 0
        search = replace(self.config.search, registrations=registrations, overlaps=overlaps)
        changed = NeuralGraphOptimizer(replace(self.config, search=search))
        changed.load_state_dict(self.state_dict())
        return changed

    def attend(self, features: Tensor, place_similarity: Tensor | None) -> Tensor:
        """Attention weights ``(batch, poses, poses)`` of features ``(batch, poses, width)`` ("Attention Phase")."""
        queries = self.query(features)
        if self.config.attention == "sum":
            # The paper divides by a sum that can vanish; queries of one sign, like the features, keep it positive.
            logits = torch.relu(queries) @ features.mT + 1e-6
            return logits / logits.sum(-1, keepdim=True)
        logits = queries @ features.mT / math.sqrt(features.shape[-1])
        if place_similarity is not None:
            logits = logits + 10.0 * self.place_gain * place_similarity
        return torch.softmax(logits, dim=-1)

    def convolve(self, inputs: Tensor, products: "_Products") -> Tensor:
        """The optimisation phase's convolutions: ``(batch, poses, channels)`` to ``(batch, poses, width)``."""
        hidden = normed = inputs
        for weight, bias, neighbours, norm in zip(*products.convolutions, self.norms, strict=True):
            # As one product it is several times as fast as torch's dilated convolutions.
            padded = nn.functional.pad(normed, (0, 0, 0, 1)).index_select(1, neighbours)
            beside = padded.reshape(normed.shape[0], normed.shape[1], -1)
            out = torch.relu(nn.functional.linear(beside, weight, bias))
            hidden = out + hidden if self.config.residual and out.shape == hidden.shape else out
            # Without it nine layers, run five times, let the features grow until gates and stiffness saturate.
            normed = norm(hidden)
        return normed

    @property
    def block(self) -> int:
        """Steps in a meta-pose."""
        return self.config.aggregation.block

    def registered(
        self,
        relative: Tensor,
        log_std: Tensor,
        place_codes: Tensor,
        pair_head: PairHead,
        origin_code: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The odometry ``relative`` and ``log_std`` ``(batch, steps, 3)`` as this optimizer takes it, and its loops.

        Measured again by the ranges in the codes, as ``registered_steps`` does, or as it is where none or loops alone
        are registered.
        """
        registrations = self.config.registrations
        return registered_steps(pair_head, relative, log_std, place_codes, self.block, registrations, origin_code)

    def find_loops(self, relative: Tensor, place_codes: Tensor, pair_head: PairHead) -> Loops:
        """Loop candidates of trajectories; ``place_codes`` ``(batch, steps, code_length)`` are of each step's end."""
        return find_loops(pair_head, place_codes, poses_in_blocks(relative, self.block), self.config.search)

    def aggregate(self, relative: Tensor, log_std: Tensor, motion_features: Tensor) -> MetaSteps:
        """Meta-steps of trajectories whose number of steps is a multiple of the block; arguments as of ``forward``."""
        if self.config.smoother is not None:
            relative, log_std = self.smoother(relative, log_std, motion_features)
        in_blocks = poses_in_blocks(relative, self.block)
        features = self.aggregation(relative, log_std, motion_features) if self.config.network else None
        std = block_variances(in_blocks, log_std).sqrt()
        return MetaSteps(in_blocks[..., -1, :], std, features, in_blocks.shape[1], in_blocks)

    def forward(
        self,
        relative: Tensor,
        log_std: Tensor,
        motion_features: Tensor,
        loops: Loops | None = None,
        fixes: CompassFixes | None = None,
    ) -> OptimizedTrajectory:
        """Optimise trajectories whose number of steps is a multiple of the block.

        Args:
            relative: relative poses ``(batch, steps, 3)`` (m, m, rad); log_std: logarithm of their deviations.
            motion_features: ``(batch, steps, motion_feature_size)``.
            loops: what ``find_loops`` found, for an optimizer with loops.
            fixes: what ``compass_fixes`` chose, for an optimizer with a compass.
        """
        result = self.optimize(self.aggregate(relative, log_std, motion_features), loops, fixes)
        poses = frame_poses(poses_in_blocks(relative, self.block), result.meta_relative[-1])
        return OptimizedTrajectory(**vars(result), poses=poses)

    def optimize(
        self, steps: MetaSteps, loops: Loops | None = None, fixes: CompassFixes | None = None
    ) -> OptimizedMetaPoses:
        """Optimise meta-poses; ``loops`` and ``fixes`` as in ``forward``, their indices count all ``steps``."""
        *_, last = self.iterate(steps, loops, fixes)
        return last

    def iterate(
        self, steps: MetaSteps, loops: Loops | None = None, fixes: CompassFixes | None = None
    ) -> Iterator[OptimizedMetaPoses]:
        """What ``optimize`` gives, after each of its iterations."""
        if self.config.loops != (loops is not None):
            given = "none were given" if loops is None else "loops were given"
            raise ValueError(f"{given} to an optimizer with{'' if self.config.loops else 'out'} loops")
        if self.config.compass != (fixes is not None):
            given = "no fixes were given" if fixes is None else "fixes were given"
            raise ValueError(f"{given} to an optimizer with{'' if self.config.compass else 'out'} a compass")
        odometry, base_std, features = steps.relative, steps.std, steps.features
        before = odometry.shape[1] - steps.blocks
        similarity = None if loops is None or features is None else loops.embeddings @ loops.embeddings.mT
        products = None if features is None else _Products(self, features.shape[1])
        adjusted, deviation, step_std = odometry, torch.zeros_like(odometry), base_std
        lattice = None if fixes is None else fixes.lattice.double()
        structure = self._structure(loops, odometry) if fixes is None else None
        results: list[Tensor] = []
        weights: Tensor | None = None
        information: Tensor | None = None
        equations: NormalEquations | None = None
        for iteration in range(self.config.iterations):
            poses = _with_origin(se2.r2g(adjusted + deviation))
            if iteration == OVERLAPS_AFTER and loops is not None:
                more = self._overlaps(loops, steps.in_blocks, poses)
                loops = loops if more is None else loops.and_also(more)
                structure = self._structure(loops, odometry) if fixes is None and more is not None else structure
            inputs: list[Tensor] = []
            if loops is not None:
                residuals = loop_residuals(loops, poses)
                expected = odometry_variances(loops.start, loops.end + 1, poses, step_std.square()).to(poses.dtype)
                if loops.most_drift is not None:
                    expected = torch.minimum(expected, loops.most_drift)
                weights, information = self.loop_gate(loops, residuals, expected, iteration)
                spread, support = spread_over_span(loops, residuals, weights, odometry.shape[1])
                spread, support = spread[:, before:], support[:, before:]
                local = torch.cat((se2.rotate(-poses[:, before:-1, 2], spread[..., :2]), spread[..., 2:]), dim=-1)
                # Residuals of many standard deviations are the rule at first: they enter by their logarithm.
                bent = torch.cat((local, deviation[:, before:]), dim=-1)
                inputs.append(torch.asinh(bent / self.correction_std.repeat(2)))
                inputs.append(torch.log1p(support))
            log_scale: Tensor | None = None
            if features is not None and products is not None:
                attended = self.attend(features, similarity) @ features
                hidden = self.convolve(torch.cat([features, attended, *inputs], dim=-1), products)
                feature, gate, change, *stiffness = products.heads(hidden)
                adjustment = torch.sigmoid(gate) * change * self.correction_std
                adjusted = torch.cat((adjusted[:, :before], adjusted[:, before:] + adjustment), dim=1)
                features = torch.relu(feature)
                log_scale = stiffness[0] if stiffness else None
            elif loops is not None:
                log_scale = self.log_scale
            if loops is not None and information is not None and log_scale is not None:
                own = base_std[:, before:] * torch.exp(3.0 * torch.tanh(log_scale / 3.0)) * self.odometry_noise
                step_std = torch.cat((base_std[:, :before], own), dim=1)
                poses = poses.double()
                factors = [
                    chain_factors(poses, deviation.double(), step_std.double()),
                    pair_factors(loops.nodes, poses, residuals.double(), information.double()),
                ]
                if fixes is not None and lattice is not None:
                    origin = torch.zeros_like(fixes.node)
                    drift = odometry_variances(origin, fixes.node, poses, step_std.square())
                    drift = drift * RobustLoopGate.ANNEALING ** (2 * iteration)
                    factors.append(compass_factors(fixes, self.compass_gate, lattice, poses, drift))
                nodes = poses.shape[1]
                if structure is not None:
                    equations = NormalEquations(factors, structure)
                    step = equations.step()
                else:
                    step = gauss_newton_step(factors, nodes if lattice is None else nodes + 1)
                after, before_it = se2.g2r(torch.cat((poses + step[:, :nodes], poses))[:, 1:]).chunk(2)
                change = after - before_it
                change = se2.wrapped(change)
                deviation = deviation + change.to(deviation.dtype)
                lattice = None if lattice is None else lattice + step[:, nodes]
            results.append(adjusted + deviation)
            yield OptimizedMetaPoses(list(results), loops, weights, information, step_std, equations)

    def _overlaps(self, loops: Loops, in_blocks: Tensor | None, poses: Tensor) -> Loops | None:
        """Loops under these poses between frames that see the same, where they are to be looked for."""
        search = self.config.search
        if search.overlaps == 0 or loops.scans is None or in_blocks is None:
            return None
        return find_overlaps(loops.scans, in_blocks, poses, loops.embeddings, search)

    def _structure(self, loops: Loops | None, odometry: Tensor) -> GraphStructure | None:
        """Of the graph that every iteration solves, where a single one is optimised and no gradient asked for."""
        if loops is None or torch.is_grad_enabled() or odometry.shape[0] != 1 or odometry.device.type != "cpu":
            return None
        blocks = odometry.shape[1]
        index = torch.arange(blocks)
        nodes = torch.cat((torch.stack((index, index + 1), dim=-1), loops.nodes[0]))
        return GraphStructure(nodes.numpy(), blocks + 1)


def _zero(layer: nn.Conv1d) -> nn.Conv1d:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


class _Products:
    """The convolutions of an optimizer as matrices, laid out once for all iterations over so many poses.

    ``convolutions`` are, for each, its weights, its bias and the poses that each pose is a neighbour of, where the one
    behind the last is a zero. Features, gates, adjustments and stiffness are one product.
    """

    def __init__(self, optimizer: NeuralGraphOptimizer, poses: int) -> None:
        layers = [layer for layer in optimizer.convolutions if isinstance(layer, nn.Conv1d)]
        weights = [layer.weight.transpose(1, 2).flatten(1) for layer in layers]
        index = torch.arange(poses, device=weights[0].device)
        offsets = torch.arange(-1, 2, device=index.device)
        neighbours = {}
        for dilation in {layer.dilation[0] for layer in layers}:
            beside = index[:, None] + dilation * offsets
            neighbours[dilation] = beside.masked_fill((beside < 0) | (beside >= poses), poses).flatten()
        self.convolutions = (weights, [layer.bias for layer in layers], [neighbours[x.dilation[0]] for x in layers])
        heads = [optimizer.feature, optimizer.gate, optimizer.adjustment]
        if optimizer.config.loops:
            heads.append(optimizer.stiffness)
        self._sizes = [head.out_channels for head in heads]
        self._weight = torch.cat([head.weight for head in heads]).squeeze(-1)
        self._bias = torch.cat([head.bias for head in heads if head.bias is not None])

    def heads(self, hidden: Tensor) -> list[Tensor]:
        """Features, gates, adjustments and, with loops, stiffness, of ``(batch, poses, width)``."""
        return list(nn.functional.linear(hidden, self._weight, self._bias).split(self._sizes, dim=-1))


def _with_origin(poses: Tensor) -> Tensor:
    return torch.cat((torch.zeros_like(poses[:, :1]), poses), dim=1)
