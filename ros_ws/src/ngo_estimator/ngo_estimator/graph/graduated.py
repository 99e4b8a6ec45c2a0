"""Graduated non-convexity over truncated least squares, with one Gauss-Newton step a stage (Yang et al. 2020).

The first stage is all but convex, so that wrong loops pull little and the poses may go far; the last one believes a
loop or does not. How many stages there are follows from the graph's own largest residual.
"""

import numpy as np

from ngo_estimator.graph.corrector import STEP_LIMIT, GraphProblem, Progress, normal_equations, silent, thresholds
from ngo_estimator.graph.normal_equations import GraphStructure

_GROWTH = 1.4
"""Of the control from stage to stage."""

_NEAR_GROWTH = 2.0
"""The same where poses are nearly right, or follow no more."""

_AT_REST = 1e-2
"""Size of a step (m, rad) below which poses follow no more."""

_MOST_STAGES = 100
_LEAST_STEP = 1e-3
"""Size of a step (m, rad) below which the poses have converged."""

_LEAST_WEIGHT = 1e-6
"""Of a step that broke: all nodes stay in one piece."""

_SPARSER = 0.7
"""The structure is worked out anew where so few of its loops still have a weight."""


def graduate(
    problem: GraphProblem,
    poses: np.ndarray,
    control: float | None = None,
    steps_break: bool = False,
    report: Progress = silent,
    structure: GraphStructure | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses ``(nodes, 3)``, and weights of loops ``(loops,)`` and of steps ``(nodes - 1,)``, from poses on.

    ``control`` is where to begin: without it so that every residual is on the convex side; 1 and above is close to the
    truncated cost, as for poses that are nearly right. ``structure`` is that of all steps and loops, where it is known.
    """
    poses, limits = poses.copy(), thresholds(problem.loops)
    squared = problem.loops.squared(poses) / limits
    near = control is not None
    if control is None:
        control = 1.0 / max(2.0 * float(squared.max(initial=0.0)) - 1.0, 1e-3)
    step_weights = np.ones(len(problem.steps))
    rows, known, loops = np.arange(len(limits)), np.ones(len(limits), bool), problem.loops
    for stage in range(_MOST_STAGES):
        weights = problem.trust * _weights(squared, control)
        believed = weights > 0.0
        if structure is None or believed.sum() < _SPARSER * len(rows) or (believed & ~known).any():
            rows, known = np.flatnonzero(believed), believed
            loops = problem.loops[rows]
            structure = GraphStructure(np.concatenate((problem.steps.nodes, loops.nodes)), len(poses))
        parts = (problem.steps, step_weights), (loops, weights[rows])
        step = normal_equations(poses, *parts, structure=structure).solution()
        poses = poses + step
        squared = problem.loops.squared(poses) / limits
        if steps_break:
            off = problem.steps.squared(poses) / STEP_LIMIT
            step_weights = np.maximum(_weights(off, control), _LEAST_WEIGHT)
        report(f"graduated non-convexity, stage {stage + 1}: {(squared <= 1.0).sum()} of {len(squared)} loops fit")
        decided, moved = _weights(squared, control), np.abs(step).max()
        if moved < _LEAST_STEP and ((decided < 0.01) | (decided > 0.99)).all():
            break
        control *= _NEAR_GROWTH if near or moved < _AT_REST else _GROWTH
    poses[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
    return poses, problem.trust * (squared <= 1.0), step_weights


def _weights(squared: np.ndarray, control: float) -> np.ndarray:
    """Weights for residuals ``(n,)``, squared and by their threshold (Yang et al. 2020, eq. 14)."""
    between = np.sqrt(control * (control + 1.0) / np.maximum(squared, 1e-30)) - control
    weights: np.ndarray = np.clip(between, 0.0, 1.0)
    return weights
