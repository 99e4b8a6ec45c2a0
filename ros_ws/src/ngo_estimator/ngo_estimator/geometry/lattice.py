"""Poses in a square lattice, up to the lattice's own symmetries: the algebra of compass readings.

A *reading* ``(u, v, psi)`` (m, m, rad) says that a pose in the lattice is ``(u + i block_m, v + j block_m, psi)``
with whole ``i`` and ``j``, turned by a multiple of 90 degrees about the lattice's origin. Two readings of one pose that
differ by these symmetries, as they do on both sides of ``psi = 45`` degrees, mean the same.
"""

import math

import torch
from torch import Tensor

from ngo_estimator.geometry import se2

_QUARTER = math.pi / 2.0
_REWEIGHTINGS = 6


def reading_of(poses: Tensor, block_m: float) -> Tensor:
    """The reading ``(..., 3)`` of poses ``(..., 3)`` in the lattice, within half a block and an eighth of a turn."""
    quarters = torch.round(poses[..., 2] / _QUARTER)
    uv = quarter_turned(-quarters, poses[..., :2])
    psi = poses[..., 2] - quarters * _QUARTER
    return torch.cat((uv - block_m * torch.round(uv / block_m), psi.unsqueeze(-1)), dim=-1)


def snapped(readings: Tensor, poses: Tensor, block_m: float) -> Tensor:
    """The poses ``(..., 3)`` in the lattice that agree with ``readings`` ``(..., 3)`` and lie nearest to ``poses``.

    First the heading, within an eighth of a turn, then the position, within half a block along either axis. The yaw is
    near that of ``poses``, which need not be wrapped. Differentiable in the readings; the poses only choose.
    """
    quarters = torch.round((poses[..., 2] - readings[..., 2]).detach() / _QUARTER)
    uv = quarter_turned(quarters, readings[..., :2])
    cells = torch.round((poses[..., :2] - uv).detach() / block_m)
    yaw = readings[..., 2] + quarters * _QUARTER
    return torch.cat((uv + cells * block_m, yaw.unsqueeze(-1)), dim=-1)


def initial_lattice(
    readings: Tensor, log_scale: Tensor, poses: Tensor, block_m: float, drift: tuple[float, float] = (0.003, 0.001)
) -> Tensor:
    """The lattice's pose ``(..., 3)`` in the map, from the first frames that a compass has read.

    The frame's pose in the lattice is then ``se2.between(lattice, pose)``. It is one of the equivalent lattices: its
    yaw lies within an eighth of a turn of 0, its origin within half a block along either of its axes.

    Args:
        readings, log_scale: ``(..., frames, 3)`` and ``(..., frames, 2)`` of the frames, the first one first.
        poses: ``(..., frames, 3)`` of the frames in the map, by odometry.
        block_m: side of the lattice's cells.
        drift: what the odometry loses from one of the frames to the next (m, rad). The more it is against the scales of
            the readings, the faster the frames count less than the first one, where the map begins.
    """
    age = torch.arange(poses.shape[-2], dtype=poses.dtype, device=poses.device)
    readings, scale = readings.to(poses.dtype), log_scale.to(poses.dtype).exp()
    # A random walk of steps q, measured with deviation s, is smoothed best by weights that fall by exp(-q / s) a step.
    decay = scale.new_tensor(drift) / (math.sqrt(2.0) * scale.median(-2, keepdim=True).values)
    weight = torch.exp(-age.unsqueeze(-1) * decay)
    yaw = _circular_median(poses[..., 2:] - readings[..., 2:], _QUARTER, weight[..., 1], scale[..., 1]).squeeze(-1)
    turned = se2.between(torch.stack((0.0 * yaw, 0.0 * yaw, yaw), dim=-1).unsqueeze(-2), poses)
    offset = _circular_median(
        snapped(readings, turned, block_m)[..., :2] - turned[..., :2], block_m, weight[..., 0], scale[..., 0]
    )
    return se2.inverse(torch.cat((offset, -yaw.unsqueeze(-1)), dim=-1))


def _circular_median(values: Tensor, period: float, weight: Tensor, scale: Tensor) -> Tensor:
    """Weighted geometric median ``(..., n)`` over the frames of periodic values ``(..., frames, n)``.

    Found by weighing the circular mean again; a value within its ``scale`` ``(..., frames)`` of it weighs no more.
    """
    phase = values * (2.0 * math.pi / period)
    weights = (weight / scale.square()).unsqueeze(-1)
    for _ in range(_REWEIGHTINGS):
        mean = torch.atan2((weights * phase.sin()).sum(-2), (weights * phase.cos()).sum(-2))
        error = se2.wrap(phase - mean.unsqueeze(-2)).norm(dim=-1) * (period / (2.0 * math.pi))
        weights = (weight / (scale * torch.maximum(error, scale))).unsqueeze(-1)
    return mean * (period / (2.0 * math.pi))


def quarter_turned(quarters: Tensor, xy: Tensor) -> Tensor:
    """Vectors ``(..., 2)`` turned by whole ``quarters`` ``(...)`` of a circle, exactly."""
    turn = torch.remainder(quarters, 4.0)
    cos = (turn == 0).to(xy.dtype) - (turn == 2).to(xy.dtype)
    sin = (turn == 1).to(xy.dtype) - (turn == 3).to(xy.dtype)
    x, y = xy[..., 0], xy[..., 1]
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)
