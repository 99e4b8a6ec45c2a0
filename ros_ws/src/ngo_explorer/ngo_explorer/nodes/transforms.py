"""Planar poses from /tf and /tf_static: the newest transform of each frame, along the chain between two."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from tf2_msgs.msg import TFMessage

_LONGEST = 20  # frames in a chain; a longer one goes in a circle

Pose = NDArray[np.float64]


class TransformTree:
    """Who is whose parent, where in it and since when: x, y and yaw, whatever else a transform says."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose, float]] = {}

    def take(self, message: TFMessage, static: bool = False) -> None:
        """Take the transforms of a message; those that are not finite are left out. ``static``: they have no time."""
        for placed in message.transforms:
            moved = placed.transform.translation
            pose = np.array((moved.x, moved.y, yaw_of(placed.transform.rotation)))
            stamp = placed.header.stamp
            stamp_s = 0.0 if static else stamp.sec + 1e-9 * stamp.nanosec
            if np.isfinite(pose).all():
                self._parents[placed.child_frame_id.lstrip("/")] = placed.header.frame_id.lstrip("/"), pose, stamp_s

    def pose(self, frame: str, child: str) -> tuple[Pose, float] | None:
        """Pose ``(3,)`` of a frame in one of those above it, and when it was there; None where they are not joined.

        The time is that of the lowest transform that has one, in s: what lies above it moves seldom. 0: none has.
        """
        found, found_s = np.zeros(3), 0.0
        for _ in range(_LONGEST):
            if child == frame:
                return found, found_s
            if child not in self._parents:
                return None
            child, pose, stamp_s = self._parents[child]
            found, found_s = _composed(pose, found), found_s or stamp_s
        return None


def yaw_of(rotation: object) -> float:
    """Turn about +z of a quaternion."""
    x, y, z, w = (float(getattr(rotation, name)) for name in "xyzw")
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _composed(first: Pose, second: Pose) -> Pose:
    cos, sin = math.cos(first[2]), math.sin(first[2])
    return np.array(
        (
            first[0] + cos * second[0] - sin * second[1],
            first[1] + sin * second[0] + cos * second[1],
            math.remainder(first[2] + second[2], math.tau),
        )
    )
