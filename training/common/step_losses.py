"""Losses and errors of relative poses, of single steps and of windows of several."""

import math

import torch
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from ngo_estimator.geometry import se2

HEADING_WEIGHT = 3.0  # Weight of a turn in the loss, beside 1 for each component of the position.
LIKELIHOOD_WEIGHT = 0.1  # Weight of the likelihood of the stated deviations, beside the loss on poses.


def windows_within(steps: int, windows: tuple[int, ...]) -> tuple[int, ...]:
    """The ``windows`` that are not longer than this number of steps."""
    return tuple(window for window in windows if window <= steps)


def step_losses(
    mean: Tensor, log_std: Tensor, truth: Tensor, std: Tensor, windows: tuple[int, ...] = (1,)
) -> tuple[Tensor, Tensor]:
    """Smooth-L1 on relative poses ``(..., 3)`` in units of ``std``, and the likelihood of what ``log_std`` says.

    The first is the mean over ``windows``. A window of ``k`` steps along the last axis but one has the sum of their
    errors, divided by the root of ``k``. So all windows weigh the same where errors are independent, and longer ones
    weigh more where errors last, as with a robot that has momentum. The sum of the errors is the drift in heading, and
    nearly the drift in position while the robot turns little.
    """
    error = (mean - truth) / std
    weight = error.new_tensor([1.0, 1.0, HEADING_WEIGHT])
    pose_loss = error.new_zeros(())
    for window in windows:
        drift = error if window == 1 else error.unfold(-2, window, 1).sum(-1) / math.sqrt(window)
        loss = smooth_l1_loss(drift, torch.zeros_like(drift), reduction="none", beta=0.1)
        pose_loss = pose_loss + (loss * weight).mean() / len(windows)
    log_scale = log_std - std.log()
    # The errors are detached: a network that may trade accuracy for a modest belief ends with less accuracy.
    likelihood = (0.5 * (error.detach() * torch.exp(-log_scale)).square().clamp(max=50.0) + log_scale).mean()
    return pose_loss, likelihood


def step_metrics(mean: Tensor, log_std: Tensor, truth: Tensor) -> dict[str, float]:
    """Errors a step: RMSE (m, deg), constant bias (m, deg) and how many predicted deviations the errors have."""
    error = mean - truth
    error = se2.wrapped(error).double()
    return {
        "rmse_m": float(error[:, :2].square().sum(1).mean().sqrt()),
        "rmse_deg": float(error[:, 2].square().mean().sqrt().rad2deg()),
        "bias_forward_m": float(error[:, 0].mean()),
        "bias_deg": float(error[:, 2].mean().rad2deg()),
        "normalized_error": float((error / log_std.exp()).square().mean().sqrt()),
    }
