"""The peers: GTSAM's Levenberg-Marquardt and iSAM2, on the poses and loops that the optimizer saw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.meta_poses import MetaSteps
from training.baselines.graph_peers import xyyaw
from training.baselines.pose_graph import PoseGraphSettings

SETTINGS = PoseGraphSettings()
"""How far odometry and loops are believed, and the robust kernel: those of the classical baseline."""

INCREMENTAL = {"isam2": 1, "isam2_default": 10}
"""Settings of iSAM2, by name: how many updates there are from one relinearisation to the next."""

_KERNELS = {
    "none": None,
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "dcs": gtsam.noiseModel.mEstimator.DCS,
}


@dataclass(frozen=True)
class Problem:
    """A window without key frames: ``relative`` and ``std`` ``(blocks, 3)``, and ``n`` loops.

    ``nodes`` ``(n, 2)``; ``measured`` ``(n, 3)``, the later node seen from the earlier one, with its deviations
    ``loop_std`` ``(n, 3)`` and the belief ``logit`` ``(n,)``.
    """

    relative: np.ndarray
    std: np.ndarray
    nodes: np.ndarray
    measured: np.ndarray
    loop_std: np.ndarray
    logit: np.ndarray

    @classmethod
    def of(cls, steps: MetaSteps, loops: Loops) -> Problem:
        """What an optimizer was given; raises ``ValueError`` where key frames stand before the window."""
        if steps.relative.shape[1] != steps.blocks:
            raise ValueError("the window has slid: there are key frames; expected a window that holds everything")
        valid = loops.valid[0]
        return cls(
            relative=steps.relative[0].double().numpy(),
            std=steps.std[0].double().numpy(),
            nodes=loops.nodes[0][valid].numpy(),
            measured=loops.measured[0][valid].double().numpy(),
            loop_std=loops.log_scale[0][valid].double().exp().numpy()[:, [0, 0, 1]],
            logit=loops.logit[0][valid].numpy(),
        )

    def where(self, which: np.ndarray) -> Problem:
        """The same with some of the loops."""
        kept = {name: getattr(self, name)[which] for name in ("nodes", "measured", "loop_std", "logit")}
        return Problem(self.relative, self.std, **kept)


class LevenbergMarquardt:
    """A batch solver from odometry; everything but ``solve`` is made before."""

    def __init__(self, problem: Problem) -> None:
        self._graph, self._start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._graph.add(_anchor())
        for node, pose in enumerate(_from_origin(problem.relative)):
            self._start.insert(node, gtsam.Pose2(*pose))
        for node in range(len(problem.relative)):
            self._graph.add(_step(problem, node))
        for loop in range(len(problem.nodes)):
            self._graph.add(_loop(problem, loop))
        self._parameters = gtsam.LevenbergMarquardtParams()
        self._parameters.setRelativeErrorTol(1e-4)
        self._parameters.setAbsoluteErrorTol(1e-4)

    def solve(self) -> gtsam.Values:
        """The minimum."""
        return gtsam.LevenbergMarquardtOptimizer(self._graph, self._start, self._parameters).optimize()


class Incremental:
    """iSAM2, updated meta-pose by meta-pose with the loops that are new.

    Each ``skip``-th update relinearises all that moved far enough.
    """

    def __init__(self, skip: int = 1) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = skip
        self._isam = gtsam.ISAM2(parameters)
        self._last = np.zeros(3)
        self._seen: set[tuple[int, int]] = set()
        self._nodes = 0

    def prepare(self, problem: Problem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """What is new in a problem that has one meta-pose more than the last one."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if self._nodes == 0:
            graph.add(_anchor())
            values.insert(0, gtsam.Pose2())
        node = len(problem.relative) - 1
        if node != self._nodes:
            raise ValueError(f"the problem has {node + 1} meta-poses; expected {self._nodes + 1}")
        relative = torch.from_numpy(problem.relative[node])
        predicted = se2.compose(torch.from_numpy(self._last), relative).numpy()
        values.insert(node + 1, gtsam.Pose2(*predicted))
        graph.add(_step(problem, node))
        for loop, pair in enumerate(map(tuple, problem.nodes.tolist())):
            if pair not in self._seen:
                self._seen.add(pair)
                graph.add(_loop(problem, loop))
        self._nodes += 1
        return graph, values

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """The solution with what ``prepare`` gave."""
        self._isam.update(graph, values)
        return self._isam.calculateEstimate()

    def estimate(self) -> gtsam.Values:
        """The solution as it is."""
        return self._isam.calculateEstimate()

    def keep(self, estimate: gtsam.Values) -> None:
        """Let the next meta-pose begin where this solution ends."""
        self._last = xyyaw(estimate)[-1]


def _from_origin(relative: np.ndarray) -> np.ndarray:
    return np.concatenate((np.zeros((1, 3)), se2.r2g(torch.from_numpy(relative)).numpy()))


def _anchor() -> Any:
    return gtsam.PriorFactorPose2(0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))


def _step(problem: Problem, node: int) -> Any:
    position, heading = SETTINGS.odometry_position_scale, SETTINGS.odometry_heading_scale
    noise = gtsam.noiseModel.Diagonal.Sigmas(problem.std[node] * [position, position, heading])
    return gtsam.BetweenFactorPose2(node, node + 1, gtsam.Pose2(*problem.relative[node]), noise)


def _loop(problem: Problem, loop: int) -> Any:
    position, heading = SETTINGS.loop_position_scale, SETTINGS.loop_heading_scale
    noise: Any = gtsam.noiseModel.Diagonal.Sigmas(problem.loop_std[loop] * [position, position, heading])
    if (kernel := _KERNELS[SETTINGS.kernel]) is not None:
        noise = gtsam.noiseModel.Robust.Create(kernel.Create(SETTINGS.kernel_width), noise)
    start, end = problem.nodes[loop].tolist()
    return gtsam.BetweenFactorPose2(start, end, gtsam.Pose2(*problem.measured[loop]), noise)
