"""Believes loops one handful after another, the surest first, each judged by what the graph knows by then.

Good predictions separate right loops from wrong ones, and every loop that is believed makes the others' better.
Loops that agree with each other and are wrong together have to pass the same test, each time in a better known graph.
"""

import math

import numpy as np

from ngo_estimator.graph.corrector import GraphProblem, Progress, normal_equations, silent, thresholds
from ngo_estimator.graph.loop_evidence import predicted_odds
from ngo_estimator.graph.normal_equations import GraphStructure

_MOST_ROUNDS = 40
_SHARE = 0.5
"""How many of the loops that may be believed are, in one round."""

_AT_LEAST = 20
"""The same in loops."""

_ADDED = 0.05
"""The same as a share of those that are believed: so many more bend a graph little that so many others hold."""

_LEAST_ODDS = math.log(10.0)
"""Of a loop that is believed."""

_SURELY_WRONG = 30.0
"""A loop that is off by so many times its threshold leaves: what is known of it only grows."""

_SPARSER = 0.7
"""The structure is worked out anew where so few of its loops are left."""

_AT_REST = 1e-2
"""Size of a step (m, rad) below which no loop's verdict changes any more."""


def believe(
    problem: GraphProblem,
    poses: np.ndarray,
    believed: np.ndarray,
    area: float,
    inlier_ratio: float = 0.5,
    report: Progress = silent,
    structure: GraphStructure | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Poses ``(nodes, 3)`` and which loops are believed ``(loops,)``, beginning with those that are.

    Args:
        area: see ``map_area``.
        inlier_ratio: of the loops, before anything is known of them.
        structure: that of all steps and loops, where it is known.
    """
    poses, believed, limits = poses.copy(), believed.copy(), thresholds(problem.loops)
    prior = math.log(inlier_ratio / (1.0 - inlier_ratio)) + np.log(np.maximum(problem.trust, 1e-9))
    rows, likely = np.arange(len(problem.loops)), problem
    alive = np.ones(len(rows), bool)
    for round_ in range(_MOST_ROUNDS):
        if structure is None or alive.sum() < _SPARSER * len(rows):
            rows = np.flatnonzero(alive)
            likely = GraphProblem(poses, problem.steps, problem.loops[rows], problem.trust[rows])
            structure = likely.structure()
        parts = (problem.steps, np.ones(len(problem.steps))), (likely.loops, believed[rows].astype(np.float64))
        equations = normal_equations(poses, *parts, structure=structure)
        step = equations.solution()
        poses = poses + step
        squared = likely.loops.squared(poses)
        left = believed[rows] & (squared > limits[rows])
        ratio, off = predicted_odds(likely, poses, equations, area)
        odds = np.where(~believed[rows] & (off <= limits[rows]), ratio + prior[rows], -np.inf)
        new = np.flatnonzero(odds > _LEAST_ODDS)
        if len(new) == 0 and not left.any() and np.abs(step).max() < _AT_REST:
            break
        report(f"the surest loops first, round {round_ + 1}: {believed.sum()} of {len(believed)} loops are believed")
        most = max(_AT_LEAST, int(_SHARE * len(new)), int(_ADDED * believed.sum()))
        believed[rows[left]] = False
        believed[rows[new[np.argsort(-odds[new], kind="stable")[:most]]]] = True
        alive[rows] = believed[rows] | (off <= _SURELY_WRONG * limits[rows])
    return poses, believed
