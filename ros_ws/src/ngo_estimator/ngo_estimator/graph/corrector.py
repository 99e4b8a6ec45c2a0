"""The contract of all that correct a pose graph: a problem goes in, poses and how much each edge is believed come out.

Every sensor states its graph as a ``GraphProblem``; what solves it is a ``Corrector``. Correctors are compared by one
cost, ``truncated_cost``, so that the better of two solutions can be kept whoever made it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.stats import chi2

from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations
from ngo_estimator.graph.relative_poses import RelativePoses

INLIER_PROBABILITY = 0.99
"""A right loop's squared residual is below its threshold so often."""

STEP_LIMIT = 100.0
"""Squared residual above which a step is an outlier: odometry fails far less often than loops do."""

Progress = Callable[[str], None]
"""Takes how far a solution has come, in a few words."""


def silent(_: str) -> None:
    """Report to nobody."""


@dataclass(frozen=True)
class GraphProblem:
    """A pose graph to be corrected.

    ``poses`` ``(nodes, 3)`` (m, m, rad) are where to begin; node 0 stays where it is. ``steps`` join each node to the
    next, all nodes in one piece. ``loops`` join any two; they need not know the heading, nor the position well.
    ``trust`` ``(loops,)``, zero to one, is the belief in each loop before the graph was asked.
    """

    poses: np.ndarray
    steps: RelativePoses
    loops: RelativePoses
    trust: np.ndarray

    def __post_init__(self) -> None:
        if len(self.steps) != len(self.poses) - 1 or len(self.trust) != len(self.loops):
            raise ValueError(
                f"there are {len(self.poses)} poses, {len(self.steps)} steps, {len(self.loops)} loops and trust in "
                f"{len(self.trust)}; expected a step less than poses, and trust in every loop"
            )

    def scaled(self, variance: float) -> "GraphProblem":
        """The same with all covariances so many times as large."""
        return replace(self, steps=self.steps.scaled(variance), loops=self.loops.scaled(variance))

    def fits(self, poses: np.ndarray) -> np.ndarray:
        """Whether poses ``(nodes, 3)`` are within the threshold of each loop ``(loops,)``."""
        within: np.ndarray = self.loops.squared(poses) <= thresholds(self.loops)
        return within

    def structure(self, most_work: float = math.inf) -> GraphStructure:
        """That of all steps and loops, in this order; ``most_work`` is that of ``BlockStructure``."""
        return GraphStructure(np.concatenate((self.steps.nodes, self.loops.nodes)), len(self.poses), most_work)


@dataclass(frozen=True)
class CorrectedGraph:
    """A solution of a ``GraphProblem``, in which copies of a loop may share their trust.

    ``poses`` ``(nodes, 3)``. ``loop_weights`` ``(loops,)`` and ``step_weights`` ``(nodes - 1,)``, zero to one, say how
    much each edge is believed. ``cost`` is the truncated cost with variances ``scale`` times as large as stated, as
    they were when it was solved. ``step_scale`` and ``loop_scale`` are how many times as large as stated the variances
    of steps and loops were found to be afterwards. ``loops_from_nothing`` loops were there when the graph was last
    solved without a warm start.
    """

    problem: GraphProblem
    poses: np.ndarray
    loop_weights: np.ndarray
    step_weights: np.ndarray
    cost: float
    scale: float = 1.0
    step_scale: float = 1.0
    loop_scale: float = 1.0
    loops_from_nothing: int = 0

    def covariance(self, nodes: Sequence[int] | np.ndarray) -> np.ndarray:
        """Joint covariance ``(3 n, 3 n)`` of ``n`` nodes' poses in the map, by the edges that are believed.

        Node 0, which stays where it is, has none.
        """
        believed = self.loop_weights > 0.0
        return normal_equations(
            self.poses,
            (self.problem.steps, self.step_weights / self.step_scale),
            (self.problem.loops[believed], self.problem.trust[believed] / self.loop_scale),
        ).covariance(nodes)


class Corrector(Protocol):
    """Corrects pose graphs."""

    def correct(self, problem: GraphProblem, start: CorrectedGraph | None = None) -> CorrectedGraph:
        """Solve a problem; with ``start``, a solution of an earlier state of the same graph, warm.

        Nodes, steps and loops of ``start`` are the first of the problem's, in the same order.
        """


_THRESHOLDS = np.concatenate(((1.0,), chi2.ppf(INLIER_PROBABILITY, (1, 2, 3))))


def thresholds(loops: RelativePoses) -> np.ndarray:
    """Squared whitened residual ``(n,)`` above which a loop is an outlier, by its degrees of freedom."""
    limits: np.ndarray = _THRESHOLDS[loops.degrees]
    return limits


def truncated_cost(problem: GraphProblem, poses: np.ndarray, step_scale: float = 1.0, loop_scale: float = 1.0) -> float:
    """Truncated least squares: each edge costs its squared residual, and an outlier its threshold.

    What a loop costs is multiplied by its trust, and variances by their scales.
    """
    steps, loops = (x.squared(poses) for x in (problem.steps, problem.loops))
    refused = np.minimum(loops / loop_scale, thresholds(problem.loops))
    return float(np.minimum(steps / step_scale, STEP_LIMIT).sum() + (problem.trust * refused).sum())


def normal_equations(
    poses: np.ndarray, *parts: tuple[RelativePoses, np.ndarray], structure: GraphStructure | None = None
) -> NormalEquations:
    """The normal equations of edges, each part with weights ``(n,)`` of its information, linearised at these poses.

    ``structure`` is that of all edges in this order; without it, it is worked out.
    """
    if structure is None:
        structure = GraphStructure(np.concatenate([edges.nodes for edges, _ in parts]), len(poses))
    relative = np.concatenate([edges.relative for edges, _ in parts])
    information = np.concatenate([weights[:, None, None] * edges.information for edges, weights in parts])
    return NormalEquations(structure, poses, relative, information)
