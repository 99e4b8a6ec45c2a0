"""The classical baseline: a pose graph of the same odometry and loops as ours, optimised with GTSAM.

Nodes are the ends of the meta-steps. Odometry factors are composed meta-steps with the network's own deviations, loop
factors come from ``find_loops``. ``training.tune_pose_graph`` chooses the scales of both on validation mazes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import gtsam
import numpy as np
import torch

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.ngo.pose_aggregation import block_variances, frame_poses, poses_in_blocks
from training.baselines.graph_peers import values, xyyaw
from training.baselines.loop_factors import LoopFactors, MoreLoops

Kernel = Literal["none", "huber", "cauchy", "geman_mcclure", "dcs"]
_KERNELS: dict[str, Callable[[float], Any]] = {
    "huber": gtsam.noiseModel.mEstimator.Huber.Create,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create,
    "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure.Create,
    "dcs": gtsam.noiseModel.mEstimator.DCS.Create,
}
_HUBER_WIDTH = 1.0
_DRIFT_LEFT = (*(0.25**stage for stage in range(6)), 0.0)
_DRIFT_RAD_A_M = 0.2


@dataclass(frozen=True)
class PoseGraphSettings:
    """Settings of the pose graph. A scale multiplies the deviation that a network states."""

    block: int = 8  # Steps in a meta-pose.
    odometry_position_scale: float = 4.0  # Scale of the odometry's deviations in position.
    odometry_heading_scale: float = 2.0  # Scale of the odometry's deviations in heading.
    odometry_gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of a step's x, y and turn: a constant calibration of the odometry."""
    odometry_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Bias that is then added to each step (m, m, rad).
    search: LoopSearch = field(default_factory=lambda: LoopSearch(per_pose=4, most=500, views=1))
    """Which pairs of frames become loop candidates."""
    min_logit: float = 2.0  # Belief from which on a loop enters the graph.
    loop_position_scale: float = 1.0  # Scale of the loops' deviations in position.
    loop_heading_scale: float = 0.5  # Scale of the loops' deviations in heading.
    kernel: Kernel = "geman_mcclure"  # Robust kernel over loops.
    kernel_width: float = 2.0  # Parameter of the kernel over loops, in deviations.
    drift_m: float = 1.0
    """Drift of the odometry that the graph allows at first. It is added in squares to each loop's deviation, a fifth of
    it in rad to that of the heading. Each stage has a quarter of it, the last one none (graduated non-convexity). With
    0 the graph starts with a convex kernel instead."""

    def __post_init__(self) -> None:
        check_positive(self, "odometry_position_scale odometry_heading_scale loop_position_scale loop_heading_scale")
        check_positive(self, "kernel_width")
        check(self, "odometry_gain odometry_bias", "finite numbers", math.isfinite)
        if not len(self.odometry_gain) == len(self.odometry_bias) == 3:
            raise ValueError(
                f"odometry_gain, odometry_bias are {self.odometry_gain}, {self.odometry_bias}; expected x, y, turn"
            )
        check(self, "kernel", f"none or one of {', '.join(_KERNELS)}", lambda kernel: kernel in ("none", *_KERNELS))
        check(self, "drift_m", "0 or more", lambda x: 0.0 <= x < math.inf)
        check(self, "min_logit", "a number", lambda x: not math.isnan(x))
        check(self, "block", "at least 1", lambda x: x >= 1)

    def calibrated(self, relative: np.ndarray) -> np.ndarray:
        """Steps ``(..., 3)`` of the odometry after the constant calibration, float64."""
        return np.asarray(relative, dtype=np.float64) * self.odometry_gain + self.odometry_bias


def optimize(
    relative: np.ndarray,
    log_std: np.ndarray,
    loops: LoopFactors,
    settings: PoseGraphSettings,
    more: MoreLoops | None = None,
) -> np.ndarray:
    """Poses ``(steps, 3)`` after each step, seen from the first frame, float64.

    Args:
        relative: steps ``(steps, 3)`` of the odometry (m, m, rad), a whole number of blocks.
        log_std: logarithm of their standard deviations ``(steps, 3)``.
        loops: loop candidates, from ``found_loops`` of the calibrated odometry.
        more: gives further loops, of the meta-poses ``(blocks + 1, 3)`` that the graph comes to without them.
    """
    steps = torch.from_numpy(settings.calibrated(relative)).unsqueeze(0)
    in_blocks = poses_in_blocks(steps, settings.block)
    variances = block_variances(in_blocks, torch.from_numpy(np.asarray(log_std, dtype=np.float64)).unsqueeze(0))
    odometry = in_blocks[0, :, -1], variances[0].sqrt().numpy()
    graph = _Graph(*odometry, loops, settings)
    if more is not None:
        graph = _Graph(*odometry, loops.and_also(more(graph.solve())), settings)
    poses = torch.from_numpy(graph.solve())
    meta_relative = se2.between(poses[:-1], poses[1:])
    return frame_poses(in_blocks, meta_relative.unsqueeze(0))[0].numpy()


class _Graph:
    """A trajectory's factors. Node ``k`` is the pose before meta-step ``k``."""

    def __init__(
        self, meta_relative: torch.Tensor, meta_std: np.ndarray, loops: LoopFactors, settings: PoseGraphSettings
    ) -> None:
        self._settings = settings
        self._odometry = np.concatenate((np.zeros((1, 3)), se2.r2g(meta_relative).numpy()))
        self._base = gtsam.NonlinearFactorGraph()
        anchor = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
        self._base.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), anchor))
        deviations = _noises(meta_std, settings.odometry_position_scale, settings.odometry_heading_scale)
        for node, (step, noise) in enumerate(zip(meta_relative.numpy(), deviations, strict=True)):
            self._base.add(gtsam.BetweenFactorPose2(node, node + 1, gtsam.Pose2(*step), noise))
        believed = loops.logit >= settings.min_logit
        scale = np.exp(loops.log_scale[believed].astype(np.float64))[:, [0, 0, 1]]
        by = np.array([settings.loop_position_scale, settings.loop_position_scale, settings.loop_heading_scale])
        self._loop_deviations = scale * by
        self._loops = [
            (start, end + 1, gtsam.Pose2(*measured))
            for start, end, measured in zip(
                loops.start[believed].tolist(),
                loops.end[believed].tolist(),
                loops.measured[believed].astype(np.float64),
                strict=True,
            )
        ]

    def solve(self) -> np.ndarray:
        """Poses ``(blocks + 1, 3)`` from odometry and loops."""
        return xyyaw(self._loop_closed())

    def _loop_closed(self) -> gtsam.Values:
        settings, found = self._settings, values(self._odometry)
        last = settings.kernel, settings.kernel_width
        if settings.drift_m == 0.0 or settings.kernel == "none":
            stages = [(*kernel, 0.0) for kernel in dict.fromkeys((self._convex, last))]
        else:
            stages = [(*self._convex, settings.drift_m), *((*last, settings.drift_m * share) for share in _DRIFT_LEFT)]
        for stage in stages:
            found = _minimum(self._with_loops(*stage), found)
        return found

    def _with_loops(self, kernel: Kernel, width: float, drift_m: float = 0.0) -> gtsam.NonlinearFactorGraph:
        graph = self._base.clone()
        drift = drift_m * np.array([1.0, 1.0, _DRIFT_RAD_A_M])
        noises = _noises(np.hypot(self._loop_deviations, drift), 1.0, 1.0)
        for (start, end, measured), noise in zip(self._loops, noises, strict=True):
            graph.add(gtsam.BetweenFactorPose2(start, end, measured, _robust(noise, kernel, width)))
        return graph

    @property
    def _convex(self) -> tuple[Kernel, float]:
        """The kernel far from the minimum, where most others pull at nothing."""
        return ("none", self._settings.kernel_width) if self._settings.kernel == "none" else ("huber", _HUBER_WIDTH)


def _noises(deviation: np.ndarray, position_scale: float, heading_scale: float) -> list[Any]:
    """Noise models of deviations ``(n, 3)``."""
    scaled = deviation * np.array([position_scale, position_scale, heading_scale])
    return [gtsam.noiseModel.Diagonal.Sigmas(row) for row in scaled]


def _robust(noise: Any, kernel: Kernel, width: float) -> Any:
    if kernel == "none":
        return noise
    return gtsam.noiseModel.Robust.Create(_KERNELS[kernel](width), noise)


def _minimum(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-4)
    parameters.setAbsoluteErrorTol(1e-4)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
