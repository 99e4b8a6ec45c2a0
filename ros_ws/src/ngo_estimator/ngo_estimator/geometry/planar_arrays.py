"""Planar rigid motions as numpy arrays of ``[x, y, yaw]``: ``se2`` without torch and without gradients.

Every function takes float64 arrays of shape ``(..., 3)`` (m, m, rad; REP-103) and broadcasts. ``planar_motion`` has the
compiled functions of single poses.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def wrap(angle: Array) -> Array:
    """Angles (rad, any shape) mapped into ``(-pi, pi]``."""
    return angle - 2.0 * math.pi * np.ceil((angle - math.pi) / (2.0 * math.pi))


def compose(a: Array, b: Array) -> Array:
    """The pose that applies ``b`` in the frame of ``a``; the yaw is wrapped."""
    return _joined(a[..., :2] + _rotated(a[..., 2], b[..., :2]), a[..., 2] + b[..., 2])


def inverse(a: Array) -> Array:
    """The pose that undoes ``a``."""
    return _joined(_rotated(-a[..., 2], -a[..., :2]), -a[..., 2])


def between(a: Array, b: Array) -> Array:
    """Pose ``b`` seen from pose ``a``: ``compose(a, between(a, b))`` is ``b``."""
    return _joined(_rotated(-a[..., 2], b[..., :2] - a[..., :2]), b[..., 2] - a[..., 2])


def _rotated(yaw: Array, xy: Array) -> Array:
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = xy[..., 0], xy[..., 1]
    return np.stack((cos * x - sin * y, sin * x + cos * y), axis=-1)


def _joined(xy: Array, yaw: Array) -> Array:
    return np.concatenate((xy, wrap(yaw)[..., None]), axis=-1)
