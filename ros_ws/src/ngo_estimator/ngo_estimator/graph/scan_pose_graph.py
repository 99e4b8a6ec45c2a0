"""A pose graph over key scans: a chain of steps and robust loops, each with a whole information matrix.

It is the loop closing of the Neural Graph Optimizer where no network takes part. Every iteration gates loops and steps
by their residuals under the current poses, and takes a Gauss-Newton step. It begins at the last solution. Steps are
gated since registration can be wrong and sure of it: the graph may break there if loops say so.
"""

import numpy as np

from ngo_estimator.graph.corrector import normal_equations
from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations
from ngo_estimator.graph.relative_poses import RelativePoses

_LEAST_STEP = 1e-4
"""Size of a step (m, rad) below which the poses have converged."""

_HALVINGS = 4
"""How often a step that does not help is halved."""


class ScanPoseGraph:
    """One optimisation: a chain of ``steps`` between neighbours, and ``loops`` with their gates.

    Args:
        steps: of node 0 to the last, in their order.
        loops: between any two nodes.
        gates: trust in each loop ``(n,)``, zero to one.
        poses: where to begin ``(nodes, 3)``, node 0 at the place where it stays.
        kernel: width of the Cauchy kernel on all residuals, in deviations.
    """

    def __init__(
        self, steps: RelativePoses, loops: RelativePoses, gates: np.ndarray, poses: np.ndarray, kernel: float
    ) -> None:
        self._steps, self._loops, self._gates = steps, loops, gates
        self._kernel = kernel
        self.poses = poses.copy()
        self.weights = gates.copy()
        """What the loops weigh ``(n,)``, zero to one."""
        self.converged = False
        self._structure = GraphStructure(np.concatenate((steps.nodes, loops.nodes)), len(poses))
        self._cost = self._total(self.poses)

    def iterate(self) -> None:
        """Gate the loops by their residuals, and take a step that lowers the cost."""
        self.weights = self._gates * self._kernel_weights(self._loops)
        step = self._equations(self._steps).solution()
        for _ in range(_HALVINGS):
            poses = self.poses + step
            cost = self._total(poses)
            if cost <= self._cost:
                break
            step = 0.5 * step
        else:
            self.converged = True
            return
        poses[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
        self.converged = bool(np.abs(step).max() < _LEAST_STEP)
        self.poses, self._cost = poses, cost

    def covariance(self, steps: RelativePoses, node: int) -> np.ndarray:
        """Covariance ``(3, 3)`` of a node's pose where the steps are known as well as ``steps`` say."""
        return self._equations(steps).covariance([node])

    def _equations(self, steps: RelativePoses) -> NormalEquations:
        """Those of ``steps`` and of the loops, at the present poses and weights."""
        parts = (steps, self._kernel_weights(self._steps)), (self._loops, self.weights)
        return normal_equations(self.poses, *parts, structure=self._structure)

    def _kernel_weights(self, measured: RelativePoses) -> np.ndarray:
        squared = (measured.residuals(self.poses) ** 2).sum(1)
        weights: np.ndarray = 1.0 / (1.0 + squared / self._kernel**2)
        return weights

    def _total(self, poses: np.ndarray) -> float:
        costs = [np.log1p((x.residuals(poses) ** 2).sum(1) / self._kernel**2) for x in (self._steps, self._loops)]
        return float(self._kernel**2 * (costs[0].sum() + (self._gates * costs[1]).sum()))
