"""Registration of range scans: where was this frame, seen from that one, so that their walls coincide?

Not in the paper. A measurement of a network is the start, and its deviations a prior; each step pairs the points of one
scan with the lines between neighbouring points of the other, and takes a robust Gauss-Newton step on their distances
(point-to-line ICP: Censi 2008), with less and less tolerance.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ngo_estimator.geometry import se2

_EDGE_ON = 0.08
"""A line that passes the scanner closer than this share of its range joins two surfaces, and is none."""

_ALIKE = 0.9
"""Least cosine between the directions of two surfaces that may be one."""

_FEWEST = 0.35
"""Share of the points seen by both scanners that must lie on their lines, or the start stands."""

_SEEN_BY_BOTH = 0.15
"""Share of the rays that are taken to be seen by both, where they are fewer."""

_FARTHEST = 25.0
"""Squared deviations of the prior, over three components, from which on scans and start contradict each other."""

_TOGETHER = 1024  # pairs that are registered at once


@dataclass(frozen=True)
class RegistrationConfig:
    """How scans are registered.

    ``rays`` ranges from left to right over ``field_of_view_deg``, straight ahead in the middle; ``noise_m`` is the
    deviation of a range, beside ``noise_share`` of itself. A point counts less the farther it is from its line: a
    quarter at a tolerance, which is as wide as the start is uncertain, at most ``widest_tolerance_m``, and a quarter of
    that in every further step, at least ``last_tolerance`` deviations of its range. With ``odometry`` the ranges are
    good enough to measure steps again, and not loops alone.
    """

    rays: int
    field_of_view_deg: float
    noise_m: float
    widest_tolerance_m: float = 0.2
    noise_share: float = 0.0
    last_tolerance: float = 5.0
    odometry: bool = True

    def __post_init__(self) -> None:
        if self.rays < 8 or not 0.0 < self.field_of_view_deg <= 360.0:
            raise ValueError(
                f"rays, field_of_view_deg are {self.rays}, {self.field_of_view_deg}; expected at least 8, and over 0 "
                "to 360"
            )
        if not 0.0 < self.noise_m <= self.widest_tolerance_m < math.inf:
            raise ValueError(
                f"noise_m, widest_tolerance_m are {self.noise_m}, {self.widest_tolerance_m}; expected positive "
                "distances, the noise no larger than the tolerance"
            )
        if not (0.0 <= self.noise_share < 1.0 and 0.0 < self.last_tolerance < math.inf):
            raise ValueError(
                f"noise_share, last_tolerance are {self.noise_share}, {self.last_tolerance}; expected a share of 0 to "
                "below 1, and a positive number of deviations"
            )

    @property
    def angles_rad(self) -> Tensor:
        """The angles of the rays ``(rays,)``, counter-clockwise from straight ahead, leftmost first."""
        half = math.radians(self.field_of_view_deg) / 2.0
        return torch.linspace(half, -half, self.rays)


@dataclass(frozen=True)
class Scans:
    """Ranges ``(batch, steps, rays)`` of the frame after each step (m, 0: no return), and how to register them."""

    ranges: Tensor
    registration: RegistrationConfig


def register(
    config: RegistrationConfig, a: Tensor, b: Tensor, start: Tensor, log_std: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Register pairs of scans; no gradient goes through it.

    Args:
        a, b: ranges ``(..., rays)`` in m, 0 where nothing came back.
        start: pose of ``b`` in the frame of ``a`` ``(..., 3)`` (m, m, rad), as far as it is known.
        log_std: logarithm of its deviations ``(..., 2)`` (position in m, heading in rad).
        steps: Gauss-Newton steps; with none the start is returned.

    Returns:
        The pose ``(..., 3)`` and the logarithm of its deviations ``(..., 2)``, of the dtype of ``start``. Where too few
        points find a line, or the scans and the start contradict each other, both are as they were.
    """
    shape, kind = start.shape[:-1], start.dtype
    if steps == 0 or start.numel() == 0:
        return start, log_std
    with torch.no_grad():
        flat = [x.expand(*shape, -1).reshape(-1, x.shape[-1]).float() for x in (a, b, start, log_std)]
        chunks = zip(*(x.split(_TOGETHER) for x in flat), strict=True)
        parts = [_register(config, one, steps) for one in map(_Pairs._make, chunks)]
        pose, after = (torch.cat(column) for column in zip(*parts, strict=True))
    return pose.to(kind).reshape(*shape, 3), after.to(kind).reshape(*shape, 2)


class _Pairs(NamedTuple):
    """As the arguments of ``register``, ``(n, ...)``."""

    a: Tensor
    b: Tensor
    start: Tensor
    log_std: Tensor


def _register(config: RegistrationConfig, pairs: _Pairs, steps: int) -> tuple[Tensor, Tensor]:
    a, b, start, log_std = pairs
    half = math.radians(config.field_of_view_deg) / 2.0
    increment = 2.0 * half / (config.rays - 1)
    angles = config.angles_rad.to(a)
    directions = torch.stack((angles.cos(), angles.sin()), dim=-1)
    lines, points, normals, there = _surfaces(a, b, directions)
    prior = torch.exp(-2.0 * log_std)[:, [0, 0, 1]]
    # How far the points may be from where the start has them.
    away = torch.exp(2.0 * log_std)
    farthest = (away[:, 0] + away[:, 1] * b.square().mean(-1)).sqrt().unsqueeze(-1)
    pose = start
    information = torch.diag_embed(prior)
    share = torch.zeros_like(start[:, 0])
    solved = torch.ones_like(share, dtype=torch.bool)  # not where prior and points together leave a direction open
    variance = config.noise_m**2 + points.square().sum(-1) * config.noise_share**2
    least = config.last_tolerance * variance.sqrt()
    for step in range(steps):
        turned = se2.rotate(pose[:, 2:], points)
        seen = turned + pose[:, None, :2]
        place = (half - torch.atan2(seen[..., 1], seen[..., 0])) / increment
        inside = (place >= 0.0) & (place < config.rays - 1)
        index = place.clamp(0.0, config.rays - 2).long()
        line = lines.gather(1, index.unsqueeze(-1).expand(-1, -1, 3))
        normal = line[..., :2]
        distance = (normal * seen).sum(-1) - line[..., 2]
        both = inside & there & (line[..., 2] != 0.0)
        alike = (se2.rotate(pose[:, 2:], normals) * normal).sum(-1) > _ALIKE
        tolerance = torch.maximum(2.0 * 0.25**step * farthest.clamp(max=0.5 * config.widest_tolerance_m), least)
        weight = (both & alike) / (1.0 + (distance / tolerance).square()).square()
        lever = normal[..., 1] * turned[..., 0] - normal[..., 0] * turned[..., 1]
        jacobian = torch.cat((normal, lever.unsqueeze(-1)), dim=-1)
        weighted = jacobian * (weight / variance).unsqueeze(-1)
        moved = se2.wrapped(start - pose)
        information = weighted.mT @ jacobian + torch.diag_embed(prior)
        gradient = -(weighted * distance.unsqueeze(-1)).sum(1) + prior * moved
        change, singular = torch.linalg.solve_ex(information, gradient)
        solved &= (singular == 0) & change.isfinite().all(-1)
        pose = torch.where(solved.unsqueeze(-1), pose + change, pose)
        share = weight.sum(-1) / both.sum(-1).clamp(min=_SEEN_BY_BOTH * config.rays)
    return _where_better(start, log_std, prior, se2.wrapped(pose), information, share * solved)


def _surfaces(a: Tensor, b: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lines of ``a`` ``(n, rays - 1, 3)`` (normal and distance; no normal where there is none), and of ``b`` its points
    ``(n, rays - 1, 2)``, the directions of their surfaces, and whether there are any."""
    found = []
    for ranges in (a, b):
        points = ranges.unsqueeze(-1) * directions
        along = points[:, 1:] - points[:, :-1]
        length = along.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        normal = torch.stack((-along[..., 1], along[..., 0]), dim=-1) / length
        distance = (normal * points[:, :-1]).sum(-1)
        nearer = torch.minimum(ranges[:, :-1], ranges[:, 1:])
        surface = (distance.abs() > _EDGE_ON * nearer) & (nearer > 0.0)
        found.append((points[:, :-1], normal * surface.unsqueeze(-1), distance * surface, surface))
    (_, normal, distance, _), (points, normals, _, there) = found
    return torch.cat((normal, distance.unsqueeze(-1)), dim=-1), points, normals, there


def _where_better(
    start: Tensor, log_std: Tensor, prior: Tensor, pose: Tensor, information: Tensor, share: Tensor
) -> tuple[Tensor, Tensor]:
    moved = se2.wrapped(pose - start)
    covariance, singular = torch.linalg.inv_ex(information)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    after = torch.stack((variance[:, :2].mean(-1), variance[:, 2]), dim=-1).log() * 0.5
    good = (share >= _FEWEST) & ((moved.square() * prior).sum(-1) <= _FARTHEST) & after.isfinite().all(-1)
    good &= singular == 0
    good = (good & pose.isfinite().all(-1)).unsqueeze(-1)
    return torch.where(good, pose, start), torch.where(good, after, log_std)
