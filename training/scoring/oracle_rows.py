"""What limits the results: rows in which one part of the estimate after the other is replaced by the truth.

What is known is believed ten times as much as it was, so that it counts without being out of all proportion to what
the networks have seen.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.meta_poses import Correction, MetaSteps, OptimizedMetaPoses, Solution
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from training.baselines.graph_settings import load_settings
from training.baselines.loop_factors import LoopFactors, smoothed_odometry
from training.baselines.pose_graph import PoseGraphSettings
from training.scoring.row_estimators import Arrays, Estimator, estimators, optimized_by, pose_graph
from training.scoring.table_rows import Sources

LIMITED_WORLDS = ("maze3d",)
"""Worlds whose results say what limits them."""

RIGHT_M, RIGHT_RAD = 0.5, math.radians(10.0)
"""Errors up to which a loop's measurement counts as right."""

_MORE_BELIEF = math.log(10.0)


@dataclass(frozen=True)
class Limit:
    """A row of the table of limits: what it is, the row whose estimator it is, and what that is told."""

    title: str
    row: str
    headings: bool = False
    positions: bool = False
    exact_loops: bool = False
    right_loops: bool = False

    @property
    def components(self) -> list[int]:
        """Which of x, y and turn of the odometry's steps are true."""
        return [0, 1] * self.positions + [2] * self.headings


LIMITS = {
    "ngo_5_true_headings": Limit("`ngo_5`, true turns in the odometry", "ngo_5", headings=True),
    "ngo_5_true_positions": Limit("`ngo_5`, true lengths and sides of the odometry's steps", "ngo_5", positions=True),
    "ngo_5_exact_loops": Limit("`ngo_5`, the pairs that it finds measured exactly", "ngo_5", exact_loops=True),
    "gtsam_true_headings": Limit("`gtsam`, true turns in the odometry", "gtsam", headings=True),
    "gtsam_true_positions": Limit("`gtsam`, true lengths and sides of the odometry's steps", "gtsam", positions=True),
    "gtsam_right_loops": Limit("`gtsam`, its wrong loops known and left out, no kernel", "gtsam", right_loops=True),
    "gtsam_exact_loops": Limit("`gtsam`, the pairs that it finds measured exactly", "gtsam", exact_loops=True),
}
"""Beside these stand `true_pairs` (retrieval) and `oracle` (retrieval and measurement)."""


def limit_estimator(name: str, sources: Sources) -> Estimator:
    """The estimator of a row of ``LIMITS``; of optimizers that of the first training seed."""
    limit = LIMITS[name]
    (base, *_) = estimators(limit.row, 1, sources)
    pair_head = load_place(sources.networks, sources.world.name)[0].pair_head
    if limit.row == "gtsam":
        settings = _untouched(load_settings(sources.settings_file()), limit)
        block = settings.block

        def known(found: LoopFactors, truth: np.ndarray) -> LoopFactors:
            return exact_factors(found, truth, block) if limit.exact_loops else right_factors(found, truth, block)

        if limit.exact_loops or limit.right_loops:
            settings = replace(settings, kernel="none")
            poses = pose_graph("gtsam", settings, pair_head, known)
        else:
            poses = pose_graph("gtsam", settings, pair_head)
    else:
        trained, _ = load_optimizer(sources.row_folder(limit.row, 0), sources.world.name)
        optimizer, smooth = apart(trained)
        corrected = optimized_by(optimizer, pair_head, informed=InformedOptimizer if limit.exact_loops else None)
        # What is true stays so: it is told after the odometry was smoothed.
        return Estimator(lambda arrays: corrected(told(smooth(arrays), limit)), f"{name} {base.identity}")
    return Estimator(lambda arrays: poses(told(arrays, limit)), f"{name} {base.identity}")


def apart(optimizer: NeuralGraphOptimizer) -> tuple[NeuralGraphOptimizer, Callable[[Arrays], Arrays]]:
    """An optimizer without what smooths the odometry, and the arrays as that smooths them (whole blocks)."""
    if optimizer.config.smoother is None:
        return optimizer, lambda arrays: arrays
    without = optimizer.with_smoother(None).eval().requires_grad_(False)

    def smooth(arrays: Arrays) -> Arrays:
        odometry = (arrays[name] for name in ("relative", "log_std", "motion"))
        relative, log_std = smoothed_odometry(optimizer.smoother, *odometry)
        return {**arrays, "relative": relative, "log_std": log_std}

    return without, smooth


def _untouched(settings: PoseGraphSettings, limit: Limit) -> PoseGraphSettings:
    """The settings without a calibration of what is true already."""
    gain, bias = list(settings.odometry_gain), list(settings.odometry_bias)
    for component in limit.components:
        gain[component], bias[component] = 1.0, 0.0
    return replace(settings, odometry_gain=(gain[0], gain[1], gain[2]), odometry_bias=(bias[0], bias[1], bias[2]))


def told(arrays: Arrays, limit: Limit) -> Arrays:
    """The arrays with those components of the odometry's steps true that a limit says."""
    chosen = limit.components
    if not chosen:
        return arrays
    truth = se2.g2r(torch.from_numpy(np.array(arrays["truth"], dtype=np.float64))).numpy()
    relative, log_std = np.array(arrays["relative"]), np.array(arrays["log_std"])
    relative[..., chosen] = truth[..., chosen]
    log_std[..., chosen] -= _MORE_BELIEF
    return {**arrays, "relative": relative, "log_std": log_std}


def exact_loops(loops: Loops, truth: Tensor, block: int) -> Loops:
    """Loops measured as they truly are, and believed more.

    Args:
        truth: true poses after each step ``(batch, steps, 3)``.
    """
    nodes = _nodes(truth, block)
    rows = torch.arange(len(nodes)).unsqueeze(1)
    measured = se2.between(nodes[rows, loops.start], nodes[rows, loops.end + 1])
    return replace(loops, measured=measured.to(loops.measured.dtype), log_scale=loops.log_scale - _MORE_BELIEF)


class InformedOptimizer(NeuralGraphOptimizer):
    """An optimizer whose loops are measured exactly, those included that it finds under corrected poses.

    Args:
        optimizer: gives configuration and weights.
        truth: true poses ``(batch, steps, 3)`` after each step of the trajectories that it is given.
    """

    def __init__(self, optimizer: NeuralGraphOptimizer, truth: Tensor) -> None:
        super().__init__(optimizer.config)
        self.load_state_dict(optimizer.state_dict())
        self.eval().requires_grad_(False)
        self._truth = truth

    def iterate(
        self,
        steps: MetaSteps,
        loops: Loops | None = None,
        corrections: Sequence[Correction] | None = None,
        solution: Solution | None = None,
    ) -> Iterator[OptimizedMetaPoses]:
        exact = None if loops is None else exact_loops(loops, self._truth, self.block)
        return super().iterate(steps, exact, corrections, solution)

    def overlaps(self, steps: MetaSteps, loops: Loops, poses: Tensor) -> Loops | None:
        found = super().overlaps(steps, loops, poses)
        return None if found is None else exact_loops(found, self._truth, self.block)


def exact_factors(found: LoopFactors, truth: np.ndarray, block: int) -> LoopFactors:
    """The same of the classical graph's loops, ``truth`` ``(steps, 3)``."""
    return replace(found, measured=_measured(found, truth, block), log_scale=found.log_scale - _MORE_BELIEF)


def right_factors(found: LoopFactors, truth: np.ndarray, block: int) -> LoopFactors:
    """Those of the loops whose measurement is right within ``RIGHT_M`` and ``RIGHT_RAD``."""
    error = found.measured - _measured(found, truth, block)
    turn = np.abs(np.remainder(error[:, 2] + np.pi, 2.0 * np.pi) - np.pi)
    right = (np.linalg.norm(error[:, :2], axis=1) <= RIGHT_M) & (turn <= RIGHT_RAD)
    return LoopFactors(*(getattr(found, name)[right] for name in found.__dataclass_fields__))


def _measured(found: LoopFactors, truth: np.ndarray, block: int) -> np.ndarray:
    nodes = _nodes(torch.from_numpy(np.array(truth, dtype=np.float64)), block)
    return se2.between(nodes[found.start], nodes[found.end + 1]).numpy()


def _nodes(truth: Tensor, block: int) -> Tensor:
    """True poses ``(..., blocks + 1, 3)`` before the first meta-step and after each, of those after each step."""
    ends = truth[..., block - 1 :: block, :].double()
    return torch.cat((torch.zeros_like(ends[..., :1, :]), ends), dim=-2)
