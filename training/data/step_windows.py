"""Errors of stretches of key steps, and the likelihood that scaled covariances give them.

Errors that repeat from step to step add up faster than independent ones. The likelihood therefore counts stretches of
several lengths, with covariances propagated to their ends.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from training.data.lidar_steps import KeySteps

WINDOWS = (1, 4, 16, 64)
"""Steps in a stretch."""

FREEDOM = 5.0
"""Degrees of freedom of Student's distribution: few steps fail, and these must not decide."""


@dataclass(frozen=True)
class StepWindows:
    """Stretches of one length.

    ``jacobian`` ``(n, steps, 3, 3)``: of the end's pose, seen from the start, by each step's error. ``covariance``
    ``(n, steps, 3, 3)`` and ``evidence`` ``(n, steps, 12)`` of the steps. ``rest`` ``(n, 3, 3)``: covariance of the end
    that no network scales. ``error`` ``(n, 3)`` of the end's pose.
    """

    jacobian: Tensor
    covariance: Tensor
    evidence: Tensor
    rest: Tensor
    error: Tensor

    def __len__(self) -> int:
        return len(self.error)

    def __getitem__(self, rows: Tensor) -> "StepWindows":
        """Some of the stretches."""
        return StepWindows(
            self.jacobian[rows], self.covariance[rows], self.evidence[rows], self.rest[rows], self.error[rows]
        )

    @staticmethod
    def joined(parts: "list[StepWindows]") -> "StepWindows":
        """The stretches of several drives."""
        return StepWindows(
            *(
                torch.cat([getattr(part, name) for part in parts])
                for name in ("jacobian", "covariance", "evidence", "rest", "error")
            )
        )


def windows_of(
    drive: KeySteps, steps: int, floor: tuple[float, float], reference: tuple[float, float] = (0.0, 0.0)
) -> StepWindows:
    """Stretches of ``steps`` steps, each a quarter of its length after the last one.

    Args:
        floor: deviations (m, rad) that the graph adds to each step.
        reference: deviations (m, rad) of the reference's poses.
    """
    starts = torch.arange(0, max(len(drive.relative) - steps + 1, 0), max(1, steps // 4))
    rows = starts.unsqueeze(1) + torch.arange(steps)
    truth = torch.from_numpy(drive.truth)
    chain = torch.cat((torch.zeros(1, 3, dtype=torch.float64), se2.r2g(torch.from_numpy(drive.relative)[None])[0]))
    origin = chain[starts].unsqueeze(1)
    before, after = se2.between(origin, chain[rows]), se2.between(origin, chain[rows + 1])
    cos, sin = before[..., 2].cos(), before[..., 2].sin()
    arm = after[:, -1:, :2] - after[..., :2]
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    jacobian = torch.stack((cos, -sin, -arm[..., 1], sin, cos, arm[..., 0], zero, zero, one), dim=-1)
    jacobian = jacobian.unflatten(-1, (3, 3))
    error = se2.wrapped(after[:, -1] - se2.between(truth[starts], truth[starts + steps]))
    added = torch.tensor((floor[0], floor[0], floor[1]), dtype=torch.float64).square().diag()
    rest = (jacobian @ added @ jacobian.mT).sum(1)
    rest = rest + 2.0 * torch.tensor((reference[0], reference[0], reference[1]), dtype=torch.float64).square().diag()
    covariance, evidence = (torch.from_numpy(values)[rows] for values in (drive.covariance, drive.evidence))
    return StepWindows(*(x.float() for x in (jacobian, covariance, evidence, rest, error)))


def squared_deviations(windows: StepWindows, log_factors: Tensor) -> tuple[Tensor, Tensor]:
    """Squared Mahalanobis distances ``(n,)`` of the errors, and half the logarithms of the covariances' determinants.

    ``log_factors`` ``(n, steps, 2)`` scale the deviations of position and heading.
    """
    factors = log_factors.exp()[..., [0, 0, 1]]
    jacobian = windows.jacobian * factors.unsqueeze(-2)
    covariance = (jacobian @ windows.covariance @ jacobian.mT).sum(1) + windows.rest
    root = torch.linalg.cholesky(covariance)
    whitened = torch.linalg.solve_triangular(root, windows.error.unsqueeze(-1), upper=False)
    return whitened.squeeze(-1).square().sum(-1), root.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def negative_log_likelihood(windows: StepWindows, log_factors: Tensor) -> Tensor:
    """Of the errors ``(n,)`` by Student's distribution, up to a constant."""
    squared, log_root = squared_deviations(windows, log_factors)
    return log_root + 0.5 * (FREEDOM + 3.0) * torch.log1p(squared / FREEDOM)


def figures(windows: StepWindows, log_factors: Tensor) -> dict[str, float]:
    """Mean negative log-likelihood, the share of errors within three deviations, and their median in deviations."""
    squared, _ = squared_deviations(windows, log_factors)
    return {
        "nll": float(negative_log_likelihood(windows, log_factors).mean()),
        "within_3": float((squared <= 9.0).float().mean()),
        "median_deviations": math.sqrt(float(squared.median())),
    }
