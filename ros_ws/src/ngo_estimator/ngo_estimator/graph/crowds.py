"""Many loops at one place are not as many witnesses: neighbours err together, the steps of the odometry do not.

Where most loops of a place are wrong in one way, as by a constant offset, they outvote the odometry, and a wrong
solution is the cheapest. Where a crowd counts as a few loops, the odometry that it bends speaks against it.
"""

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
    """A ``Corrector`` that solves the problem ``without_crowds``, too; the truncated cost of that one judges.

    No solution costs more by this cost than the robust one's. One that was reached warm stays.

    Args:
        told, least_scale: see ``Robust``.
    """

    def __init__(self, told: Told = silent, least_scale: float = LEAST_SCALE) -> None:
        self._told, self._least_scale = told, least_scale

    def correct(self, problem: GraphProblem, start: CorrectedGraph | None = None) -> CorrectedGraph:
        """Solve a problem; see ``Corrector``."""
        robust = Robust(self._told, self._least_scale)
        best = robust.correct(problem, start)
        if len(problem.loops) == 0 or best.loops_from_nothing < len(problem.loops):
            return best
        once = best.problem  # copies share their trust
        fair = without_crowds(once.scaled(best.scale))
        begun = robust.correct(without_crowds(problem)).poses
        found = finished(once, begun, best.scale, self._told, self._least_scale)
        cheaper = truncated_cost(fair, found.poses) < (1.0 - _MARGIN) * truncated_cost(fair, best.poses)
        return found if cheaper else best
