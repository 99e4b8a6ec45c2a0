"""Loops that place codes alone cannot tell from others: each needs the odometry's consent, and witnesses.

Not in the paper. On maps that nobody trained on, the belief of the pair head tells little: of the loops that it is sure
of, one in twenty joins one place. Among those that the odometry allows it is two in three, and nine in ten of those to
which two others nearby agree (docs/explanation/findings.md).
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.optimizer.gauss_newton import pick
from ngo_estimator.optimizer.loop_closure import Loops
from ngo_estimator.optimizer.loop_residuals import loop_residuals, odometry_variances
from ngo_estimator.optimizer.meta_poses import MetaSteps, with_origin

WITHIN = 2.2
"""Deviations of the odometry between its poses that a loop may be off, over x, y and yaw together."""

NEAR = 8
"""Meta-poses, at both ends, from a loop to its witnesses: what the odometry says of so few is known well."""

_NOISE_M, _NOISE_RAD = 0.1, 0.05
"""Deviation of a loop that joins one place."""

_AGREEING_M, _AGREEING_RAD = 0.35, 0.1
"""How far two loops that agree may differ."""


def agreeing(loops: Loops, steps: MetaSteps, fewest: int) -> Loops:
    """The loops; those that the odometry does not allow, or that have too few witnesses, are not valid.

    A loop needs ``fewest`` witnesses for each deviation by which it is off: the more it changes, the more must say so.
    Its own deviation grows with the root of their number.
    A witness is another loop that the odometry allows, to another frame, both of whose ends are near. Led along the
    odometry from end to end, both say the same.
    """
    with torch.no_grad():
        poses = with_origin(se2.r2g(steps.relative.double()))
        variance = odometry_variances(loops.start, loops.end + 1, poses, steps.std.double().square())
        noise = variance.new_tensor((_NOISE_M, _NOISE_M, _NOISE_RAD)).square()
        squared = (loop_residuals(loops, poses).square() / (variance + noise)).sum(-1)
        valid = loops.valid & (squared <= WITHIN**2)
        found = torch.stack([_witnesses(loops, poses, valid, batch) for batch in range(len(valid))])
        valid = valid & (found >= fewest * squared.sqrt())
        # What is not valid joins neighbours: the equations are as sparse as without it.
        # Loops that agree err together: all of them count as one.
        together = 0.5 * torch.log1p(found.to(loops.log_scale.dtype)).unsqueeze(-1)
        start = torch.where(valid, loops.start, loops.end)
        return dataclasses.replace(loops, valid=valid, start=start, log_scale=loops.log_scale + together)


def _witnesses(loops: Loops, poses: Tensor, valid: Tensor, batch: int) -> Tensor:
    """Other frames ``(loops,)`` whose loops agree with each, of one trajectory."""
    index = valid[batch].nonzero()[:, 0]
    count = torch.zeros_like(loops.start[batch])
    if len(index) < 2:
        return count
    start, end = loops.start[batch, index], loops.end[batch, index] + 1
    near = ((start[:, None] - start).abs() <= NEAR) & ((end[:, None] - end).abs() <= NEAR) & (end[:, None] != end)
    one, other = near.nonzero().unbind(-1)
    measured = loops.measured[batch, index].double()
    at = [pick(poses[batch : batch + 1], nodes[None])[0] for nodes in (start, end)]
    led = se2.compose(se2.between(at[0][one], at[0][other]), measured[other])
    led = se2.compose(led, se2.between(at[1][other], at[1][one]))
    apart = se2.wrapped(se2.between(led, measured[one]))
    agree = (apart[:, :2].norm(dim=-1) < _AGREEING_M) & (apart[:, 2].abs() < _AGREEING_RAD)
    pairs = torch.unique(torch.stack((one, end[other]), dim=-1)[agree], dim=0)  # several loops of a frame are one
    count[index] = torch.bincount(pairs[:, 0], minlength=len(index))
    return count
