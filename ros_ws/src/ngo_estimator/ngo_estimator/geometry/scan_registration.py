"""Registration of range scans: where was this frame, seen from that one, so that their walls coincide?

A measurement of a network is the start, and its deviations a prior; each step pairs the points of one
scan with the lines between neighbouring points of the other, and takes a robust Gauss-Newton step on their distances
(point-to-line ICP: Censi 2008), with less and less tolerance.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.configuration import check, check_positive


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
        check(self, "rays", "at least 8", lambda x: x >= 8)
        check(self, "field_of_view_deg", "over 0 to 360", lambda x: 0.0 < x <= 360.0)
        check_positive(self, "noise_m widest_tolerance_m last_tolerance")
        widest_m = self.widest_tolerance_m
        check(self, "noise_m", f"no larger than the tolerance, {widest_m}", lambda x: x <= widest_m)
        check(self, "noise_share", "a share of 0 to below 1", lambda x: 0.0 <= x < 1.0)

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
    shape = start.shape[:-1]
    if steps == 0 or start.numel() == 0:
        return start, log_std
    pairs = [x.detach().expand(*shape, -1).reshape(-1, x.shape[-1]).float().cpu() for x in (a, b, start, log_std)]
    ranges_a, ranges_b, poses, deviations = (x.contiguous().numpy() for x in pairs)
    poses, deviations = poses.copy(), deviations.copy()
    angles = config.angles_rad.numpy().astype(np.float64)
    settings = (
        config.noise_m, config.noise_share, config.widest_tolerance_m, config.last_tolerance,
        math.radians(config.field_of_view_deg) / 2.0,
    )  # fmt: skip
    # The compiler's library takes 100 MB: only those pay for it that register.
    from ngo_estimator.geometry.scan_registration_kernels import register_pairs

    register_pairs(ranges_a, ranges_b, poses, deviations, np.cos(angles), np.sin(angles), settings, steps)
    pose, after = (torch.from_numpy(values).to(start) for values in (poses, deviations))
    return pose.reshape(*shape, 3), after.reshape(*shape, 2)
