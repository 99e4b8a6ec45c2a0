"""Planar rigid motions ``[x, y, yaw]`` of many poses, as numpy arrays or, where gradients are needed, torch tensors.

Every function takes values of shape ``(..., 3)`` (metres, metres, radians; REP-103: x forward, y left, yaw
counter-clockwise), all of one library, keeps their dtype and device, broadcasts and is differentiable. ``a @ b`` of two
transforms is ``compose(a, b)``: in names, ``compose(map_from_odom, odom_from_base)`` is ``map_from_base``.
``planar_motion`` has the compiled functions of single poses.
"""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Values = TypeVar("Values", "Tensor", NDArray[Any])


def library(values: Values) -> Any:
    """The library of these, numpy or torch: what is called here has one name in both, and ``axis`` for its axes."""
    return np if isinstance(values, np.ndarray | np.generic) else sys.modules["torch"]


def wrap(angle: Values) -> Values:
    """Map angles (rad, any shape) into ``(-pi, pi]``, to their own rounding; the gradient is one everywhere."""
    return angle - 2.0 * math.pi * library(angle).ceil((angle - math.pi) / (2.0 * math.pi))


def wrapped(poses: Values) -> Values:
    """Poses, or differences of poses, with their yaw in ``(-pi, pi]``."""
    return _joined(poses[..., :2], poses[..., 2])


def rotate(yaw: Values, xy: Values) -> Values:
    """Rotate vectors ``xy`` of shape ``(..., 2)`` by ``yaw`` of shape ``(...)``."""
    of = library(xy)
    cos, sin = of.cos(yaw), of.sin(yaw)
    x, y = xy[..., 0], xy[..., 1]
    turned: Values = of.stack((cos * x - sin * y, sin * x + cos * y), axis=-1)
    return turned


def compose(a: Values, b: Values) -> Values:
    """The transform that applies ``b`` in the frame of ``a``; the yaw is wrapped."""
    return _joined(a[..., :2] + rotate(a[..., 2], b[..., :2]), a[..., 2] + b[..., 2])


def inverse(a: Values) -> Values:
    """The transform that undoes ``a``."""
    return _joined(rotate(-a[..., 2], -a[..., :2]), -a[..., 2])


def between(a: Values, b: Values) -> Values:
    """Pose ``b`` seen from pose ``a``: ``compose(a, between(a, b)) == b``."""
    return _joined(rotate(-a[..., 2], b[..., :2] - a[..., :2]), b[..., 2] - a[..., 2])


def r2g(relative: Values) -> Values:
    """Accumulate relative poses ``(..., steps, 3)`` into global poses ``(..., steps, 3)``: the paper's ``r2g``.

    The origin is the identity and is not part of the result: entry ``k`` is the pose after step ``k``. One
    cumulative sum, no loop. The yaw is the plain sum (continuous, not wrapped), so that it can be supervised.
    """
    of = library(relative)
    yaw = of.cumsum(relative[..., 2], axis=-1)
    xy = of.cumsum(rotate(yaw - relative[..., 2], relative[..., :2]), axis=-2)
    poses: Values = of.concatenate((xy, yaw[..., None]), axis=-1)
    return poses


def g2r(poses: Values) -> Values:
    """Relative poses ``(..., steps, 3)`` of global poses ``(..., steps, 3)`` that start from the identity.

    The paper's ``g2r``, the inverse of ``r2g`` for steps that turn by less than half a circle.
    """
    of = library(poses)
    return between(of.concatenate((of.zeros_like(poses[..., :1, :]), poses[..., :-1, :]), axis=-2), poses)


def _joined(xy: Values, yaw: Values) -> Values:
    poses: Values = library(xy).concatenate((xy, wrap(yaw)[..., None]), axis=-1)
    return poses
