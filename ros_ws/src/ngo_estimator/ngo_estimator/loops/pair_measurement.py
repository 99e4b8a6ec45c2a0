"""Measurement of pairs of frames: the later frame as seen from the earlier one, from several views near them.

The optimizer over whole trajectories and the online trajectory both measure their loops here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import RegistrationConfig, register
from ngo_estimator.geometry.se2 import Values, library
from ngo_estimator.graph.gauss_newton import pick
from ngo_estimator.networks.place_encoder import PairHead

VIEWS = ((0, 0), (-4, -4), (4, -4), (-2, -2), (2, -2), (-4, 0), (4, 0), (0, -3), (0, -6))
"""Steps from the frames of a pair to those of its views: at the earlier frame, and at the later one."""

OVERLAP_VIEWS = VIEWS[:5]
"""The views of an overlap."""

SMALLEST_SPREAD = 1e-4  # m or rad
_REWEIGHTINGS = 3
_DRIFT_M, _DRIFT_RAD = 0.5, math.radians(5.0)
"""Deviations of a relative pose that the registration of an overlap starts from."""

_ERRING_TOGETHER = 3.0
"""Deviations of an overlap in units of those of independent views: rays of one picture err together."""


class PairViews(NamedTuple):
    """The views of pairs; the first view is of the two frames themselves.

    ``a``, ``b`` ``(views, ..., length)``: place codes, or ranges, of frames near the earlier and near the later frame.
    ``from_a`` ``(views, ..., 3)``: poses of these frames seen from the earlier frame; ``to_b``: poses of the later
    frame seen from these frames.
    """

    a: Tensor
    b: Tensor
    from_a: Tensor
    to_b: Tensor

    @classmethod
    def of_trajectories(
        cls, values: Tensor, odometry: Tensor, earlier: Tensor, later: Tensor, offsets: tuple[tuple[int, int], ...]
    ) -> PairViews:
        """Views of pairs in whole trajectories.

        Args:
            values: codes or ranges ``(batch, steps, length)``; odometry: poses of all frames ``(batch, steps, 3)``.
            earlier, later: the frames of each pair ``(batch, pairs)``.
            offsets: as ``VIEWS``; frames before the first and behind the last become these.
        """
        last = values.shape[1] - 1
        views = [((earlier + a).clamp(0, last), (later + b).clamp(0, last)) for a, b in offsets]
        start, end = pick(odometry, earlier), pick(odometry, later)
        return cls(
            torch.stack([pick(values, a) for a, _ in views]),
            torch.stack([pick(values, b) for _, b in views]),
            torch.stack([se2.between(start, pick(odometry, a)) for a, _ in views]),
            torch.stack([se2.between(pick(odometry, b), end) for _, b in views]),
        )


class PairMeasurement(NamedTuple):
    """The later frame of each pair as seen from the earlier one.

    ``measured`` ``(..., 3)`` (m, m, rad); ``log_scale`` ``(..., 2)``, logarithm of its scale (position in m, heading in
    rad); ``spread`` ``(..., 2)``, logarithm of how far the views disagree.
    """

    measured: Tensor
    log_scale: Tensor
    spread: Tensor


def measure_pairs(
    pair_head: PairHead, views: PairViews, registrations: int, first: tuple[Tensor, Tensor] | None = None
) -> tuple[PairMeasurement, Tensor]:
    """Measure pairs of place codes from several views, fuse these robustly, and register the ranges of the codes.

    The pair head errs differently from frame to frame; the odometry over a few steps errs little.

    Args:
        registrations: iterations of the registration, 0 for none.
        first: the pair head's pose and logarithm of scales for the first view, if they are known.

    Returns:
        The measurement, and the logit ``(...)`` that the two frames show one place (zeros if ``first`` is given).
    """
    todo = 0 if first is None else 1
    measured, log_scale, logits = pair_head(views.a[todo:], views.b[todo:])
    if first is None:
        logit = logits[0]
    else:
        measured, log_scale = (
            torch.cat((a.unsqueeze(0), b)) for a, b in zip(first, (measured, log_scale), strict=True)
        )
        logit = measured.new_zeros(measured.shape[1:-1])
    if len(views.a) > 1:
        measured = se2.compose(se2.compose(views.from_a, measured), views.to_b)
        fused = fuse_views(measured, log_scale)
    else:
        spread = torch.full_like(log_scale[0], math.log(SMALLEST_SPREAD))
        fused = PairMeasurement(measured[0], log_scale[0], spread)
    if registrations:
        pose, scale = pair_head.register(views.a[0], views.b[0], fused.measured, fused.log_scale, registrations)
        fused = PairMeasurement(pose, scale, fused.spread)
    return fused, logit


def measure_overlaps(
    config: RegistrationConfig, views: PairViews, start: Tensor, steps: int
) -> tuple[PairMeasurement, Tensor]:
    """Measure pairs of frames that share walls: register the ranges of several views, and fuse these robustly.

    Args:
        views: with ranges ``(views, ..., rays)``.
        start: pose of the later frame seen from the earlier one ``(..., 3)``, as far as it is known.
        steps: iterations of each registration.

    Returns:
        The measurement, and whether most views could be registered ``(...)``.
    """
    # A registration computes in float32: a pose that it leaves alone must be found the same.
    from_a, to_b, start = views.from_a.float(), views.to_b.float(), start.float()
    guess = se2.compose(se2.compose(se2.inverse(from_a), start), se2.inverse(to_b))
    drift = guess.new_tensor([_DRIFT_M, _DRIFT_RAD]).log().expand(*guess.shape[:-1], 2)
    measured, after = register(config, views.a, views.b, guess, drift, steps)
    registered = (after != drift).any(-1)
    # A view that was not registered has nearly no weight.
    after = torch.where(registered.unsqueeze(-1), after, drift + math.log(100.0))
    fused = fuse_views(se2.compose(se2.compose(from_a, measured), to_b), after)
    most = registered.to(start.dtype).mean(0) > 0.5
    return fused._replace(log_scale=fused.log_scale + math.log(_ERRING_TOGETHER)), most


def fuse_views(measured: Tensor, log_scale: Tensor) -> PairMeasurement:
    """Fuse measurements of the same pair of frames robustly; scales as if the views erred independently.

    Args:
        measured: ``(views, ..., 3)``; log_scale: logarithm of their scales ``(views, ..., 2)``.
    """
    asked = torch.is_grad_enabled() and (measured.requires_grad or log_scale.requires_grad)
    if asked or measured.device.type != "cpu":
        return PairMeasurement(*_fused(measured, log_scale))
    # For some pairs the calls of torch cost more than their arithmetic.
    fused = _fused(measured.detach().double().numpy(), log_scale.detach().double().numpy())
    return PairMeasurement(*(torch.from_numpy(values).to(measured.dtype) for values in fused))


def _fused(measured: Values, log_scale: Values) -> tuple[Values, Values, Values]:
    """Pose ``(..., 3)``, logarithm of its scale ``(..., 2)`` and of how far the views disagree ``(..., 2)``."""
    of = library(measured)
    precision = of.exp(-2.0 * log_scale)
    error = se2.wrapped(measured - measured[0])
    weight, mean, squares = precision, error[0], precision
    for _ in range(_REWEIGHTINGS + 1):
        by_component = weight[..., [0, 0, 1]]
        mean = (by_component * error).sum(0) / by_component.sum(0)
        left = (error - mean) ** 2
        squares = of.stack((left[..., 0] + left[..., 1], left[..., 2]), axis=-1)
        weight = precision / (1.0 + 0.25 * precision * squares)
    spread = of.log(of.sqrt((weight * squares).sum(0) / weight.sum(0)).clip(SMALLEST_SPREAD))
    return se2.wrapped(measured[0] + mean), -0.5 * of.log(weight.sum(0)), spread
