"""The M iterations of the Neural Graph Optimizer (paper, section "Neural Graph Optimization").

Each one attends and optimises, Delta P^(i) = Delta P^(i-1) + beta^(i) nabla P^(i) (``attention_network``). A look at
the loops goes before it, and a step that closes them behind it (``loop_closing``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.loops.loop_closure import Loops, LoopSearch, find_loops
from ngo_estimator.loops.overlaps import find_overlaps
from ngo_estimator.loops.place_loops import PlaceLoops
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.attention_network import AttentionConfig, AttentionNetwork, AttentionPhases
from ngo_estimator.ngo.loop_closing import CHANNELS, LoopClosing, NoLoopClosing, softened
from ngo_estimator.ngo.loop_gates import RobustLoopGate, without_contradictions
from ngo_estimator.ngo.loop_judge import LoopJudge
from ngo_estimator.ngo.meta_poses import (
    Correction,
    GraphState,
    MetaSteps,
    OptimizedMetaPoses,
    OptimizedTrajectory,
    Solution,
)
from ngo_estimator.ngo.pose_aggregation import (
    PoseAggregationConfig,
    block_variances,
    frame_poses,
    poses_in_blocks,
)
from ngo_estimator.ngo.registered_odometry import registered_steps
from ngo_estimator.ngo.warm_start import Remembered, resumed

_Channels = Callable[[GraphState], Tensor]

_ODOMETRY_NOISE = (2.0, 2.0, 1.0)
"""Before anything is learned: errors of a relative meta-pose in units of the deviations that its steps add up to."""


@dataclass(frozen=True)
class NeuralGraphOptimizerConfig:
    """Configuration of the optimizer; ``paper_form`` gives the paper's."""

    aggregation: PoseAggregationConfig
    """How steps become meta-poses and their features."""
    iterations: int = 5
    """Iterations of attend and optimise, which have their weights in common."""
    attention: str = "softmax"
    """Form of the attention: ``softmax``, or ``sum`` for the paper's C / sum(C)."""
    dilations: tuple[int, ...] = (1, 1, 2, 4, 8, 4, 2, 1, 1)
    """Dilation of each convolution."""
    residual: bool = True
    """Whether each convolution is added to its input and normalised over its channels."""
    loops: bool = True
    """Whether convolutions see the residuals of loop candidates, and each iteration ends with a Gauss-Newton step."""
    network: bool = True
    """Whether there is a network; without, Gauss-Newton steps alone, and one learned factor for the odometry."""
    smoother: SmootherConfig | None = None
    """Smooths the odometry before meta-poses are made of it; None for none."""
    search: LoopSearch = field(default_factory=LoopSearch)
    """How loop candidates are found."""
    correction_std: tuple[float, float, float] = (0.05, 0.05, 0.02)
    """Unit of the adjustments, the typical error of a relative meta-pose (m, m, rad)."""
    covariance_scale: float = 1.0
    """Factor of a pose's covariance, fitted to the errors on validation data."""

    def __post_init__(self) -> None:
        check(self, "attention", "'softmax' or 'sum'", lambda form: form in ("softmax", "sum"))
        check(self, "iterations dilations", "at least 1", lambda x: x >= 1)
        if not (self.loops or self.network):
            raise ValueError(f"loops, network are {self.loops}, {self.network}; expected at least one of them")
        if self.smoother is not None and self.smoother.motion_feature_size != self.aggregation.motion_feature_size:
            raise ValueError(
                f"the smoother takes {self.smoother.motion_feature_size} motion features; expected "
                f"{self.aggregation.motion_feature_size}, as the aggregation"
            )
        check_positive(self, "correction_std covariance_scale")

    @property
    def context(self) -> int:
        """Blocks before and after a block on which its relative meta-pose and feature depend."""
        reach = 0 if self.smoother is None else self.smoother.reach
        reach += self.aggregation.reach if self.network else 0
        return math.ceil(reach / self.aggregation.block)

    @property
    def registrations(self) -> int:
        """Iterations of a scan registration; 0 if ranges are not registered."""
        return self.search.registrations if self.loops else 0

    @classmethod
    def paper_form(cls, aggregation: PoseAggregationConfig, **changes: object) -> NeuralGraphOptimizerConfig:
        """Nine plain convolutions of kernel 3 over features and attention; no place codes and no loops."""
        form: dict[str, object] = {
            "attention": "sum",
            "dilations": (1,) * 9,
            "residual": False,
            "loops": False,
        }
        return cls(aggregation=aggregation, **{**form, **changes})  # type: ignore[arg-type]


class NeuralGraphOptimizer(AttentionNetwork):
    """Redistributes the error of a trajectory by iterated attention and temporal convolution.

    ``forward`` takes the relative poses of the local network and gives P^(M) = r2g(Delta P^(M)) and what led to it;
    ``aggregate`` makes the meta-poses and their features F^(0), ``iterate`` runs the iterations. A freshly initialised
    optimizer without loops returns its input exactly; with loops it is a robust pose graph.
    """

    def __init__(self, config: NeuralGraphOptimizerConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("correction_std", torch.tensor(config.correction_std), persistent=False)
        self.correction_std: Tensor
        if config.smoother is not None:
            self.smoother = OdometrySmoother(config.smoother)
        if config.network:
            channels = CHANNELS if config.loops else 0
            self.build(
                AttentionConfig(config.aggregation, config.attention, config.dilations, config.residual, channels)
            )
        if config.loops:
            self.register_buffer("odometry_noise", torch.tensor(_ODOMETRY_NOISE), persistent=False)
            self.odometry_noise: Tensor
            self.loop_gate = RobustLoopGate()
            if config.search.least_belief:
                self.loop_judge = LoopJudge()
            if not config.network:
                self.log_scale = nn.Parameter(torch.zeros(3))

    def with_smoother(self, smoother: OdometrySmoother | None) -> NeuralGraphOptimizer:
        """The same optimizer with a copy of another smoother, or with none."""
        config = replace(self.config, smoother=None if smoother is None else smoother.config)
        values = {name: value for name, value in self.state_dict().items() if not name.startswith("smoother.")}
        if smoother is not None:
            values |= {f"smoother.{name}": value for name, value in smoother.state_dict().items()}
        changed = NeuralGraphOptimizer(config)
        changed.load_state_dict(values)
        return changed

    def with_registrations(self, registrations: int) -> NeuralGraphOptimizer:
        """The same optimizer with another number of registration iterations; with 0 it looks for no overlaps."""
        overlaps = self.config.search.overlaps if registrations else 0
        search = replace(self.config.search, registrations=registrations, overlaps=overlaps)
        changed = NeuralGraphOptimizer(replace(self.config, search=search))
        changed.load_state_dict(self.state_dict())
        return changed

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
        """The odometry as this optimizer takes it: measured again by ``registered_steps``, if it registers steps.

        Args and shapes as of ``registered_steps``.
        """
        registrations = self.config.registrations
        return registered_steps(pair_head, relative, log_std, place_codes, self.block, registrations, origin_code)

    def find_loops(self, relative: Tensor, place_codes: Tensor, pair_head: PairHead) -> Loops:
        """Loop candidates of trajectories; ``place_codes`` ``(batch, steps, code_length)`` are of each step's end."""
        return find_loops(pair_head, place_codes, poses_in_blocks(relative, self.block), self.config.search)

    def aggregate(self, relative: Tensor, log_std: Tensor, motion_features: Tensor) -> MetaSteps:
        """Meta-steps of trajectories; arguments as of ``forward``."""
        if self.config.smoother is not None:
            relative, log_std = self.smoother(relative, log_std, motion_features)
        in_blocks = poses_in_blocks(relative, self.block)
        features = self.aggregation(relative, log_std, motion_features) if self.config.network else None
        std = block_variances(in_blocks, log_std).sqrt()
        return MetaSteps(in_blocks[..., -1, :], std, features, in_blocks.shape[1], in_blocks)

    def forward(
        self, relative: Tensor, log_std: Tensor, motion_features: Tensor, loops: Loops | None = None
    ) -> OptimizedTrajectory:
        """Optimise trajectories whose number of steps is a multiple of the block.

        Args:
            relative: relative poses ``(batch, steps, 3)`` (m, m, rad); log_std: logarithm of their deviations.
            motion_features: ``(batch, steps, motion_feature_size)``.
            loops: the result of ``find_loops``, for an optimizer with loops.
        """
        result = self.optimize(self.aggregate(relative, log_std, motion_features), loops)
        poses = frame_poses(poses_in_blocks(relative, self.block), result.meta_relative[-1])
        return OptimizedTrajectory(**vars(result), poses=poses)

    def optimize(self, steps: MetaSteps, loops: Loops | None = None) -> OptimizedMetaPoses:
        """Optimise meta-poses; the indices of ``loops`` count all ``steps``."""
        *_, last = self.iterate(steps, loops)
        return last

    def iterate(
        self,
        steps: MetaSteps,
        loops: Loops | None = None,
        corrections: Sequence[Correction] | None = None,
    ) -> Iterator[OptimizedMetaPoses]:
        """Run the M iterations one by one, and yield the result after each; only the last one has its loops.

        Args:
            corrections: what the network gave in each iteration of an earlier optimisation, to be taken instead of
                running it.

        Raises:
            ValueError: loops for an optimizer without loops, or none for one with loops.
        """
        if self.config.loops != (loops is not None):
            given = "none were given" if loops is None else "loops were given"
            raise ValueError(f"{given} to an optimizer with{'' if self.config.loops else 'out'} loops")
        closing = NoLoopClosing() if loops is None else self._loop_closing(steps, loops)
        return self._annealed(steps, closing, self._phases(steps, loops, corrections))

    def resume(
        self,
        relative: np.ndarray,
        std: np.ndarray,
        given: tuple[np.ndarray, np.ndarray],
        loops: PlaceLoops,
        new_loops: Loops,
        poses: np.ndarray,
    ) -> Solution:
        """Go on from a solution; ``resumed`` describes it.

        New loops are judged as in the first iteration, which allows for the odometry's drift, and then as in the last.

        Args:
            relative, std: of the odometry ``(poses, 3)``; given: what the network adjusts of its last poses in all
                iterations, and the last stiffness of these, both ``(blocks, 3)``.
        """
        adjusted, keys = relative.copy(), len(relative) - len(given[0])
        adjusted[keys:] += given[0]
        step_std = softened(std, given[1], self.odometry_noise.double().numpy(), keys)
        iterations = 0, self.config.iterations - 1
        return resumed(self.loop_gate, iterations, (relative, std), adjusted, step_std, loops, new_loops, poses)

    def _annealed(
        self,
        steps: MetaSteps,
        closing: LoopClosing | NoLoopClosing,
        phases: AttentionPhases | _NoNetwork | Remembered,
    ) -> Iterator[OptimizedMetaPoses]:
        """The results that begin at the odometry Delta P^(0).

        All loops are judged in each iteration, allowing for less of the odometry's drift each time.
        """
        state, results = GraphState.initial(steps), []
        made: list[Correction] = []
        for iteration in range(self.config.iterations):
            closing.look(state, iteration)
            before = state.adjusted
            state, stiffness = phases.optimise(state, closing.channels)
            adjusted, stiffness = steps.without_fixed(before, state.adjusted, stiffness)
            state = replace(state, adjusted=adjusted)
            if self.config.network:
                made.append(Correction((state.adjusted - before)[:, steps.key_frames :], stiffness))
            state = closing.close(state, stiffness)
            results.append(state.relative.to(steps.relative.dtype))
            left = self.config.iterations - 1 - iteration
            result = OptimizedMetaPoses(list(results), state.step_std, made, left)
            yield result if left else closing.with_loops(result)

    def _phases(
        self, steps: MetaSteps, loops: Loops | None, corrections: Sequence[Correction] | None
    ) -> AttentionPhases | _NoNetwork | Remembered:
        if not self.config.network:
            return _NoNetwork(self)
        if corrections is not None:
            return Remembered(corrections)
        similarity = None if loops is None else loops.embeddings @ loops.embeddings.mT
        return self.phases(steps.blocks, similarity, self.correction_std)

    def overlaps(self, steps: MetaSteps, loops: Loops, poses: Tensor) -> Loops | None:
        """Further loops under corrected poses ``(batch, poses + 1, 3)``; None if they are not to be looked for."""
        search = self.config.search
        if search.overlaps == 0 or loops.scans is None or steps.in_blocks is None:
            return None
        found = find_overlaps(loops.scans, steps.in_blocks, poses, loops.embeddings, search)
        return without_contradictions(found, steps)

    def _loop_closing(self, steps: MetaSteps, loops: Loops) -> LoopClosing:
        loops = self.judged(loops, steps)
        find_overlaps = partial(self.overlaps, steps, loops)
        return LoopClosing(self.loop_gate, steps, loops, find_overlaps, self.odometry_noise, self.correction_std)

    def judged(self, loops: Loops, steps: MetaSteps) -> Loops:
        """The loops as they are closed: none that contradicts the odometry, or that the judge refuses."""
        loops, least = without_contradictions(loops, steps), self.config.search.least_belief
        return self.loop_judge.judged(loops, steps, least) if least else loops


class _NoNetwork:
    """Stands for both phases in an optimizer without a network: the same stiffness for all meta-poses."""

    def __init__(self, optimizer: NeuralGraphOptimizer) -> None:
        self._stiffness = optimizer.log_scale

    def optimise(self, state: GraphState, loops: _Channels) -> tuple[GraphState, Tensor]:
        """The state as it is, and the stiffness ``(3,)``."""
        return state, self._stiffness
