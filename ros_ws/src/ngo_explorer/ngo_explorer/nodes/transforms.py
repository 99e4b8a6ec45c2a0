"""Planar poses from /tf and /tf_static: the newest transform of each frame, along the chain between two."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from tf2_msgs.msg import TFMessage

_LONGEST = 20  # frames in a chain; a longer one goes in a circle

Pose = NDArray[np.float64]


class TransformTree:
    """Who is whose parent, and where in it: x, y and yaw, whatever else a transform says."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def take(self, message: TFMessage) -> None:
        """Take the transforms of a message; those that are not finite are left out."""
        for placed in message.transforms:
            moved = placed.transform.translation
            pose = np.array((moved.x, moved.y, yaw_of(placed.transform.rotation)))
            if np.isfinite(pose).all():
                self._parents[placed.child_frame_id.lstrip("/")] = placed.header.frame_id.lstrip("/"), pose

    def pose(self, frame: str, child: str) -> Pose | None:
        """Pose ``(3,)`` of a frame in one of those above it; None where they are not joined."""
        found = np.zeros(3)
        for _ in range(_LONGEST):
            if child == frame:
                return found
            if child not in self._parents:
                return None
            child, pose = self._parents[child]
            found = _composed(pose, found)
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
