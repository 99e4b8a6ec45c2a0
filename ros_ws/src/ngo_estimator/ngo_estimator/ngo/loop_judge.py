"""How likely a loop joins one place, and how far it may be off: learned from what is known of it before it is closed.

In mazes the pair head and the ranges tell places well, on maps that nobody trained on poorly: of the
loops that the pair head is sure of there, one in twenty joins one place. The odometry between the two poses and other
loops nearby tell much more, and how much each of them is worth depends on the others
(docs/notebook.md). The judge is small, and learns from true poses (``training.train_loop_judge``).
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from ngo_estimator.geometry import se2
from ngo_estimator.graph.gauss_newton import pick
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.loop_gates import loop_residuals, odometry_variances
from ngo_estimator.ngo.meta_poses import MetaSteps, with_origin

WITHIN = 3.0
"""Deviations of the odometry between its poses that a loop may be off, over x, y and yaw together."""

NEAR = 8
"""Meta-poses, at both ends, from a loop to its neighbours: what the odometry says of so few is known well."""

EVIDENCE = 11
"""Numbers that are known of a loop."""

_NOISE_M, _NOISE_RAD = 0.1, 0.05
"""Deviation of a loop that joins one place."""

_AGREEING_M, _AGREEING_RAD = 0.35, 0.1
"""How far two loops that agree may differ."""

_HIDDEN = 24


class LoopJudge(nn.Module):
    """Evidence of loops to the logit that they join one place, and to factors of their scales.

    ``mean`` and ``std`` ``(EVIDENCE,)`` normalise the evidence.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(EVIDENCE))
        self.register_buffer("std", torch.ones(EVIDENCE))
        self.mean: Tensor
        self.std: Tensor
        self.layers = nn.Sequential(
            nn.Linear(EVIDENCE, _HIDDEN),
            nn.ReLU(),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.ReLU(),
            nn.Linear(_HIDDEN, 3),
        )

    def forward(self, evidence: Tensor) -> tuple[Tensor, Tensor]:
        """Logit ``(...)``, and what is added to the logarithm of the scales ``(..., 2)``, of evidence ``(..., n)``."""
        out = self.layers((evidence - self.mean) / self.std)
        return out[..., 0], out[..., 1:]

    def judged(self, loops: Loops, steps: MetaSteps, least: float) -> Loops:
        """The loops with logits and scales of the judge.

        Those that the odometry does not allow, or that are less likely than ``least``, are not valid. Loops that agree
        err together: all of them count as one. Those that were found by poses stay as they are, and are nobody's
        neighbours.
        """
        with torch.no_grad():
            kept = torch.zeros_like(loops.valid) if loops.by_poses is None else loops.by_poses
            evidence, allowed = evidence_of(dataclasses.replace(loops, valid=loops.valid & ~kept), steps)
            logit, factor = self(evidence)
            valid = allowed & (torch.sigmoid(logit) > least) | (loops.valid & kept)
            together = 0.5 * evidence[..., _AGREEING].unsqueeze(-1)
            log_scale = loops.log_scale + (factor + together).to(loops.log_scale)
            return dataclasses.replace(
                loops,
                valid=valid,
                # What is not valid joins neighbours: the equations are as sparse as without it.
                start=torch.where(valid, loops.start, loops.end),
                logit=torch.where(kept, loops.logit, logit.to(loops.logit)),
                log_scale=torch.where(kept.unsqueeze(-1), loops.log_scale, log_scale),
            )


_AGREEING = 8  # column of the evidence


def evidence_of(loops: Loops, steps: MetaSteps) -> tuple[Tensor, Tensor]:
    """What is known of loops ``(batch, loops, EVIDENCE)`` float32, and which of them the odometry allows.

    These are: similarity, logit and scales; how far the loop is off from the odometry in position and in heading, in
    deviations, and these deviations; how many neighbours agree, how many do not; and its length. A neighbour is another
    loop that the odometry allows, to another frame, both of whose ends are near. Led along the odometry from end to
    end, both say the same if they agree.
    """
    poses = with_origin(se2.r2g(steps.relative.double()))
    variance = odometry_variances(loops.nodes, poses, steps.std.double().square())
    noise = variance.new_tensor((_NOISE_M, _NOISE_M, _NOISE_RAD)).square()
    squared = loop_residuals(loops.nodes, loops.measured, poses).square() / (variance + noise)
    allowed = loops.valid & (squared.sum(-1) <= WITHIN**2)
    neighbours = [_neighbours(loops, poses, allowed, batch) for batch in range(len(allowed))]
    agreeing, others = (torch.stack(column) for column in zip(*neighbours, strict=True))
    columns = (
        loops.similarity,
        loops.logit / 5.0,
        loops.log_scale[..., 0],
        loops.log_scale[..., 1],
        torch.log1p(squared[..., :2].sum(-1)),
        torch.log1p(squared[..., 2]),
        0.5 * torch.log(variance[..., :2].sum(-1) + _NOISE_M**2),
        0.5 * torch.log(variance[..., 2] + 1e-4),
        torch.log1p(agreeing.double()),
        torch.log1p(others.double()),
        loops.log_length / 3.0,
    )
    return torch.stack([column.double() for column in columns], dim=-1).float(), allowed


def _neighbours(loops: Loops, poses: Tensor, allowed: Tensor, batch: int) -> tuple[Tensor, Tensor]:
    """Frames ``(loops,)`` near those of each loop whose loops agree with it, and those whose loops do not."""
    index = allowed[batch].nonzero()[:, 0]
    counts = torch.zeros_like(loops.start[batch]), torch.zeros_like(loops.start[batch])
    if len(index) < 2:
        return counts
    start, end = loops.start[batch, index], loops.end[batch, index] + 1
    near = ((start[:, None] - start).abs() <= NEAR) & ((end[:, None] - end).abs() <= NEAR) & (end[:, None] != end)
    one, other = near.nonzero().unbind(-1)
    measured = loops.measured[batch, index].double()
    at = [pick(poses[batch : batch + 1], nodes[None])[0] for nodes in (start, end)]
    led = se2.compose(se2.between(at[0][one], at[0][other]), measured[other])
    led = se2.compose(led, se2.between(at[1][other], at[1][one]))
    apart = se2.wrapped(se2.between(led, measured[one]))
    agree = (apart[:, :2].norm(dim=-1) < _AGREEING_M) & (apart[:, 2].abs() < _AGREEING_RAD)
    pairs = torch.stack((one, end[other]), dim=-1)  # several loops of a frame are one
    agreeing, all_near = (
        torch.bincount(torch.unique(some, dim=0)[:, 0], minlength=len(index)) for some in (pairs[agree], pairs)
    )
    counts[0][index], counts[1][index] = agreeing, all_near - agreeing
    return counts
