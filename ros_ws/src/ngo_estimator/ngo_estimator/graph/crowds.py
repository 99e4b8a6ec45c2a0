"""Many loops at one place are not as many witnesses: neighbours err together, the steps of the odometry do not.

Where most loops of a place are wrong in one way, as by a constant offset, they outvote the odometry, and a wrong
solution is the cheapest. Where a crowd counts as a few loops, the odometry that it bends speaks against it.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from ngo_estimator.graph.corrector import CorrectedGraph, GraphProblem, Told, silent, truncated_cost
from ngo_estimator.graph.robust import LEAST_SCALE, Robust, finished

_CROWD = 9
"""Loops whose ends are, both, within so many nodes see the same things."""

_INDEPENDENT = 3.0
"""How many loops of such a crowd count."""

_MARGIN = 0.01
"""Share of its cost by which a solution is cheaper that takes the place of the robust one."""


def without_crowds(problem: GraphProblem) -> GraphProblem:
    """The problem with less trust in loops that are many at one place."""
    ends = np.sort(problem.loops.nodes, axis=1).astype(np.float64)
    crowd = KDTree(ends).query_ball_point(ends, _CROWD, p=np.inf, return_length=True)
    return replace(problem, trust=problem.trust * np.minimum(1.0, _INDEPENDENT / crowd))


class CrowdAware:
    """A ``Corrector`` that has more candidates than the robust one, judged by the truncated cost ``without_crowds``.

    No solution costs more by this cost than the robust one's. One that was reached warm stays.

    Args:
        told, least_scale: see ``Robust``.
    """

    def __init__(self, told: Told = silent, least_scale: float = LEAST_SCALE) -> None:
        self._told, self._least_scale = told, least_scale

    def correct(self, problem: GraphProblem, start: CorrectedGraph | None = None) -> CorrectedGraph:
        """Solve a problem; see ``Corrector``."""
        best = Robust(self._told, self._least_scale).correct(problem, start)
        if len(problem.loops) == 0 or best.loops_from_nothing < len(problem.loops):
            return best
        scale, fair = best.scale, without_crowds(problem.scaled(best.scale))
        least = (1.0 - _MARGIN) * truncated_cost(fair, best.poses)
        for poses in self.candidates(problem, fair):
            found = finished(problem, poses, scale, self._told, self._least_scale)
            cost = truncated_cost(fair, found.poses)
            if cost < least:
                best, least = found, cost
        return best

    def candidates(self, problem: GraphProblem, fair: GraphProblem) -> Iterable[np.ndarray]:
        """Poses ``(nodes, 3)`` to go on from; ``fair`` is the problem without crowds, with variances as they are."""
        yield Robust(self._told, self._least_scale).correct(without_crowds(problem)).poses
