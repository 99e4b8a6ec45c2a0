"""The Neural Graph Optimizer (paper, section "Neural Graph Optimization"), with and without loop closures."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ngo_estimator import se2
from ngo_estimator.loop_closure import Loops, find_loops, loop_residuals, spread_over_span
from ngo_estimator.loop_system import LoopSystem, end_covariance, gauss_newton_correction
from ngo_estimator.place_encoder import PairHead
from ngo_estimator.pose_aggregation import (
    PoseAggregation,
    PoseAggregationConfig,
    block_variances,
    frame_poses,
    poses_in_blocks,
)


@dataclass(frozen=True)
class NeuralGraphOptimizerConfig:
    """What the optimizer is made of; ``paper_form`` gives the paper's.

    ``iterations`` attend-optimise iterations share their weights. ``attention`` is ``softmax``, or ``sum``, the
    paper's C / sum(C). ``dilations`` holds one number a convolution; with ``residual`` each is added to its input, and
    normalised over its channels. With ``loops`` every iteration sees the residuals of the loop candidates under the
    current poses and takes a step that reduces them: ``loops_per_pose`` candidates for each meta-pose, at least
    ``min_loop_separation`` meta-poses older, and the best ``max_loops`` of the trajectory. ``correction_std`` (m, m,
    rad), the typical error of a relative meta-pose, is the unit of the adjustments.
    """

    aggregation: PoseAggregationConfig
    iterations: int = 5
    attention: str = "softmax"
    dilations: tuple[int, ...] = (1, 1, 2, 4, 8, 4, 2, 1, 1)
    residual: bool = True
    loops: bool = True
    loops_per_pose: int = 2
    max_loops: int = 96
    min_loop_separation: int = 6
    correction_std: tuple[float, float, float] = (0.05, 0.05, 0.02)

    def __post_init__(self) -> None:
        if self.attention not in ("softmax", "sum"):
            raise ValueError(f"attention is {self.attention!r}; expected 'softmax' or 'sum'")
        if self.iterations < 1 or not self.dilations or min(self.dilations) < 1:
            raise ValueError(
                f"iterations, dilations are {self.iterations}, {self.dilations}; expected at least 1, and a positive "
                "number for each convolution"
            )
        if min(self.loops_per_pose, self.max_loops, self.min_loop_separation) < 1:
            raise ValueError("loops_per_pose, max_loops and min_loop_separation must be at least 1")
        if min(self.correction_std) <= 0.0:
            raise ValueError(f"correction_std is {self.correction_std}; expected three positive numbers")

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
class OptimizedTrajectory:
    """What the optimizer gives for ``(batch, steps)``, on whole blocks of steps.

    ``poses`` ``(batch, steps, 3)``: corrected global poses of all frames after the origin. ``meta_relative``: one
    ``(batch, blocks, 3)`` for each iteration, first to last. ``loops`` with ``loop_weights`` ``(batch, loops)`` of
    the last iteration, zero to one. ``loop_information`` ``(batch, loops, 3)`` and ``step_std`` ``(batch, blocks,
    3)``: the belief in the loops and in the relative meta-poses.
    """

    poses: Tensor
    meta_relative: list[Tensor]
    loops: Loops | None
    loop_weights: Tensor | None
    loop_information: Tensor | None
    step_std: Tensor

    def end_covariance(self) -> Tensor:
        """Covariance ``(batch, 3, 3)`` of the last meta-pose in the map (x, y, yaw), float64."""
        poses = _with_origin(se2.r2g(self.meta_relative[-1].double()))
        loops = None if self.loops is None else (self.loops.start, self.loops.end)
        return end_covariance(loops, poses, self.step_std.double(), self.loop_information)


class LoopGate(nn.Module):
    """How much each loop candidate is trusted, from its similarity, length and residual."""

    def __init__(self, hidden: int = 32) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(9, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.head = nn.Linear(hidden, 3)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, loops: Loops, residuals: Tensor, expected_variance: Tensor) -> tuple[Tensor, Tensor]:
        """Gate ``(batch, loops)`` in zero to one, and information ``(batch, loops, 3)`` of each loop.

        Args:
            residuals: ``(batch, loops, 3)``.
            expected_variance: what the odometry alone lets the residuals vary ``(batch, loops, 3)``.
        """
        measured_variance = torch.exp(2.0 * loops.log_scale)
        position_variance, heading_variance = measured_variance.unbind(-1)
        position_error = residuals[..., :2].square().sum(-1)
        heading_error = residuals[..., 2].square()
        expected_position = expected_variance[..., :2].sum(-1)
        inputs = torch.stack(
            (
                loops.similarity,
                loops.logit / 5.0,
                loops.log_scale[..., 0],
                loops.log_scale[..., 1],
                torch.log((loops.end - loops.start + 1).to(residuals.dtype)) / 3.0,
                torch.log1p(position_error / (2.0 * position_variance)) / 3.0,
                torch.log1p(heading_error / heading_variance) / 3.0,
                torch.log1p(position_error / (expected_position + 2.0 * position_variance)),
                torch.log1p(heading_error / (expected_variance[..., 2] + heading_variance)),
            ),
            dim=-1,
        )
        out = self.head(self.layers(inputs))
        gate = torch.sigmoid(loops.logit + 4.0 * out[..., 0]) * loops.valid
        scale = torch.exp(4.0 * torch.tanh(out[..., 1:] / 2.0))
        position = gate * scale[..., 0] / position_variance
        heading = gate * scale[..., 1] / heading_variance
        return gate, torch.stack((position, position, heading), dim=-1)


class NeuralGraphOptimizer(nn.Module):
    """Redistributes the error of a trajectory by iterated attention and temporal convolution.

    Each iteration attends over all meta-poses, passes features and attention through the convolutions, and adds gated
    adjustments to the relative meta-poses. With ``loops`` the convolutions also see the loops' residuals, spread over
    their spans, and say how far each meta-step may bend; a Gauss-Newton step then closes the gated loops.
    A freshly initialised optimizer returns its input exactly. Unlike in the paper, features, adjustments and gates are
    read from the last convolution by three layers of kernel 1, and only the features pass through a ReLU.
    """

    def __init__(self, config: NeuralGraphOptimizerConfig) -> None:
        super().__init__()
        self.config = config
        width = config.aggregation.width
        self.aggregation = PoseAggregation(config.aggregation)
        self.query = nn.Linear(width, width)
        channels = 2 * width + (7 if config.loops else 0)
        self.convolutions, self.norms = nn.ModuleList(), nn.ModuleList()
        for dilation in config.dilations:
            self.convolutions.append(nn.Conv1d(channels, width, 3, 1, dilation, dilation))
            self.norms.append(_ChannelNorm(width) if config.residual else nn.Identity())
            channels = width
        self.feature = nn.Conv1d(width, width, 1)
        self.adjustment = nn.Conv1d(width, 3, 1)
        self.gate = nn.Conv1d(width, 1, 1)
        nn.init.zeros_(self.adjustment.weight)
        nn.init.zeros_(self.adjustment.bias)  # type: ignore[arg-type]
        self.register_buffer("correction_std", torch.tensor(config.correction_std), persistent=False)
        self.correction_std: Tensor
        if config.loops:
            self.place_gain = nn.Parameter(torch.tensor(0.0))
            self.stiffness = nn.Conv1d(width, 3, 1)
            nn.init.zeros_(self.stiffness.weight)
            nn.init.zeros_(self.stiffness.bias)  # type: ignore[arg-type]
            self.loop_gate = LoopGate()
            self.loop_gain = nn.Parameter(torch.tensor(0.0))

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

    def convolve(self, inputs: Tensor) -> Tensor:
        """The optimisation phase's convolutions: ``(batch, poses, channels)`` to ``(batch, width, poses)``."""
        hidden = normed = inputs.mT
        for layer, norm in zip(self.convolutions, self.norms, strict=True):
            out = torch.relu(layer(normed))
            hidden = out + hidden if self.config.residual and out.shape == hidden.shape else out
            # Without it nine layers, run five times, let the features grow until gates and stiffness saturate.
            normed = norm(hidden)
        return normed

    def forward(
        self,
        relative: Tensor,
        log_std: Tensor,
        motion_features: Tensor,
        place_codes: Tensor | None = None,
        pair_head: PairHead | None = None,
    ) -> OptimizedTrajectory:
        """Optimise trajectories whose number of steps is a multiple of the block.

        Args:
            relative: relative poses ``(batch, steps, 3)`` (m, m, rad); log_std: logarithm of their deviations.
            motion_features: ``(batch, steps, motion_feature_size)``.
            place_codes: ``(batch, steps, code_size)`` of the newer frame of each step, with loops only.
            pair_head: measures pairs of place codes, with loops only.
        """
        config = self.config
        in_blocks = poses_in_blocks(relative, config.aggregation.block)
        odometry = in_blocks[..., -1, :]
        blocks = odometry.shape[1]
        features = self.aggregation(relative, log_std, motion_features)
        base_std = block_variances(in_blocks, log_std).sqrt()
        loops, similarity = None, None
        if config.loops:
            if place_codes is None or pair_head is None:
                raise ValueError("an optimizer with loops needs place codes and a pair head")
            loops = find_loops(
                pair_head,
                place_codes,
                in_blocks,
                config.loops_per_pose,
                config.max_loops,
                config.min_loop_separation,
            )
            embeddings = pair_head.embed(place_codes[:, config.aggregation.block - 1 :: config.aggregation.block])
            similarity = embeddings @ embeddings.mT
        adjusted, deviation, step_std = odometry, torch.zeros_like(odometry), base_std
        results: list[Tensor] = []
        weights: Tensor | None = None
        information: Tensor | None = None
        for _ in range(config.iterations):
            attended = self.attend(features, similarity) @ features
            inputs = [features, attended]
            if loops is not None:
                poses = _with_origin(se2.r2g(adjusted + deviation))
                residuals = loop_residuals(loops, poses)
                system = LoopSystem(loops.start, loops.end, poses)
                expected = system.variances(step_std.square()).to(poses.dtype)
                weights, information = self.loop_gate(loops, residuals, expected)
                spread, support = spread_over_span(loops, residuals, weights, blocks)
                local = torch.cat((se2.rotate(-poses[:, :-1, 2], spread[..., :2]), spread[..., 2:]), dim=-1)
                # Residuals of many standard deviations are the rule at first: they enter by their logarithm.
                inputs.append(torch.asinh(torch.cat((local, deviation), dim=-1) / self.correction_std.repeat(2)))
                inputs.append(torch.log1p(support))
            hidden = self.convolve(torch.cat(inputs, dim=-1))
            beta = torch.sigmoid(self.gate(hidden)).mT
            adjusted = adjusted + beta * self.adjustment(hidden).mT * self.correction_std
            features = torch.relu(self.feature(hidden)).mT
            if loops is not None and information is not None:
                step_std = base_std * torch.exp(3.0 * torch.tanh(self.stiffness(hidden).mT / 3.0))
                total = gauss_newton_correction(system, residuals, step_std, information, deviation)
                deviation = deviation + self.loop_gain * (total.to(deviation.dtype) - deviation)
            results.append(adjusted + deviation)
        return OptimizedTrajectory(frame_poses(in_blocks, results[-1]), results, loops, weights, information, step_std)


class _ChannelNorm(nn.LayerNorm):
    """Layer normalisation over the channels of ``(batch, channels, poses)``."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 (the name that torch uses)
        return super().forward(input.mT).mT


def _with_origin(poses: Tensor) -> Tensor:
    return torch.cat((torch.zeros_like(poses[:, :1]), poses), dim=1)
