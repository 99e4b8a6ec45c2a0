"""Planar rigid motions as tensors of ``[x, y, yaw]``.

Every function takes tensors of shape ``(..., 3)`` (metres, metres, radians; REP-103: x forward, y left, yaw
counter-clockwise), keeps their dtype and device, broadcasts and is differentiable. ``a @ b`` of two transforms is
``compose(a, b)``: in names, ``compose(map_from_odom, odom_from_base)`` is ``map_from_base``.
"""

import math

import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """Map angles (rad, any shape) into ``(-pi, pi]``, to their own rounding; the gradient is one everywhere."""
    turns = torch.ceil((angle.detach() - math.pi) / (2.0 * math.pi))
    return angle - 2.0 * math.pi * turns


def wrapped(poses: Tensor) -> Tensor:
    """Poses, or differences of poses, with their yaw in ``(-pi, pi]``."""
    return torch.cat((poses[..., :2], wrap(poses[..., 2:])), dim=-1)


def rotate(yaw: Tensor, xy: Tensor) -> Tensor:
    """Rotate vectors ``xy`` of shape ``(..., 2)`` by ``yaw`` of shape ``(...)``."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    x, y = xy[..., 0], xy[..., 1]
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def compose(a: Tensor, b: Tensor) -> Tensor:
    """The transform that applies ``b`` in the frame of ``a``; the yaw is wrapped."""
    xy = a[..., :2] + rotate(a[..., 2], b[..., :2])
    return torch.cat((xy, wrap(a[..., 2:] + b[..., 2:])), dim=-1)


def inverse(a: Tensor) -> Tensor:
    """The transform that undoes ``a``."""
    return torch.cat((rotate(-a[..., 2], -a[..., :2]), wrap(-a[..., 2:])), dim=-1)


def between(a: Tensor, b: Tensor) -> Tensor:
    """Pose ``b`` seen from pose ``a``: ``compose(a, between(a, b)) == b``."""
    xy = rotate(-a[..., 2], b[..., :2] - a[..., :2])
    return torch.cat((xy, wrap(b[..., 2:] - a[..., 2:])), dim=-1)


def r2g(relative: Tensor) -> Tensor:
    """Accumulate relative poses ``(..., steps, 3)`` into global poses ``(..., steps, 3)``: the paper's ``r2g``.

    The origin is the identity and is not part of the result: entry ``k`` is the pose after step ``k``. One
    cumulative sum, no loop. The yaw is the plain sum (continuous, not wrapped), so that it can be supervised.
    """
    yaw = torch.cumsum(relative[..., 2], dim=-1)
    before = yaw - relative[..., 2]
    xy = torch.cumsum(rotate(before, relative[..., :2]), dim=-2)
    return torch.cat((xy, yaw.unsqueeze(-1)), dim=-1)


def g2r(poses: Tensor) -> Tensor:
    """Relative poses ``(..., steps, 3)`` of global poses ``(..., steps, 3)`` that start from the identity.

    The paper's ``g2r``, the inverse of ``r2g`` for steps that turn by less than half a circle.
    """
    origin = torch.zeros_like(poses[..., :1, :])
    return between(torch.cat((origin, poses[..., :-1, :]), dim=-2), poses)
