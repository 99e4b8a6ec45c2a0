"""Test of loops against the odometry between their poses.

Not in the paper. Gates weigh loops one by one, so that hundreds of wrong ones that agree win over the odometry. This
test does not count loops.
"""

from __future__ import annotations

import dataclasses

import torch

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.loop_residuals import loop_residuals, odometry_variances
from ngo_estimator.ngo.meta_poses import MetaSteps, with_origin

FARTHEST = 40.0
"""Deviations of the odometry between two poses, over x, y and yaw, beyond which a loop contradicts it.

Errors of steps are not independent: true loops of validation mazes are up to 25 deviations off in 2D (one drive of nine
has 40) and 16 in 3D, wrong ones 60 to 130 in the median (docs/explanation/findings.md).
"""

LEAST_STD = 0.01
"""Deviation of a meta-step, m and rad, at least: a registered step says a tenth of that, and is at times that wrong."""

LEAST_VARIANCE = 1e-12
"""Of the odometry between two poses, m^2 and rad^2, so that none divides by zero."""


def without_contradictions(loops: Loops, steps: MetaSteps) -> Loops:
    """The loops; those that contradict the odometry between their poses are not valid any more.

    What odometry alone says is tested, before anything is corrected: corrections by wrong loops make room for others.
    """
    with torch.no_grad():
        poses = with_origin(se2.r2g(steps.relative.double()))
        variance = odometry_variances(
            loops.start, loops.end + 1, poses, steps.std.double().clamp(min=LEAST_STD).square()
        )
        squared = (loop_residuals(loops, poses).square() / variance.clamp(min=LEAST_VARIANCE)).sum(-1)
        return dataclasses.replace(loops, valid=loops.valid & (squared <= FARTHEST**2))
