"""Poses of odometry: of nav_msgs/Odometry, also where it has the velocity alone, of poses, and of velocities."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ngo_recordings.association import header_stamp_ns

_MOVES = (0.05, 0.05)
"""Way and turn (m, rad) by the velocity, after which the velocity counts if the pose has not moved."""

_LONGEST_S = 1.0
"""Between two messages whose velocities are summed up."""


class OdometryPoses:
    """The planar pose of each message: as it is given, or summed up from velocities where no pose ever moves."""

    def __init__(self) -> None:
        self.from_velocity = False
        """Whether velocities are summed up."""
        self._first: np.ndarray | None = None
        # Whether the place and the direction were others than the first ones: as given, and by velocities.
        self._moved, self._drove = np.zeros(2, np.bool_), np.zeros(2, np.bool_)
        self._pose = np.zeros(3)
        self._last: tuple[int, np.ndarray] | None = None

    def read(self, message: Any) -> np.ndarray | None:
        """The pose ``(3,)`` of a message: m, m, rad; None where there is none.

        Raises RecordingError for a message without a stamp.
        """
        stamp_ns = header_stamp_ns(message)
        pose, twist = getattr(message, "pose", None), getattr(message, "twist", None)
        pose, twist = getattr(pose, "pose", pose), getattr(twist, "twist", twist)  # with their covariance or without
        given = None if pose is None else planar_pose(pose.position, pose.orientation)
        if twist is not None:
            velocity = np.array([twist.linear.x, twist.linear.y, twist.angular.z])
            if np.isfinite(velocity).all():
                self._sum_up(stamp_ns, velocity)
                self._judge(given)
        return self._pose.copy() if self.from_velocity or pose is None else given

    def _judge(self, given: np.ndarray | None) -> None:
        if self._first is None:
            self._first = given
        elif given is not None:
            self._moved |= (bool((given[:2] != self._first[:2]).any()), given[2] != self._first[2])
        self._drove |= (math.hypot(self._pose[0], self._pose[1]) > _MOVES[0], abs(self._pose[2]) > _MOVES[1])
        self.from_velocity = bool((self._drove & ~self._moved).any())

    def _sum_up(self, stamp_ns: int, twist: np.ndarray) -> None:
        if self._last is not None:
            elapsed_s, mean = (stamp_ns - self._last[0]) * 1e-9, 0.5 * (self._last[1] + twist)
            if elapsed_s < -_LONGEST_S:  # the source restarted
                self._pose = np.zeros(3)
            elif 0.0 < elapsed_s < _LONGEST_S:
                heading = self._pose[2] + 0.5 * elapsed_s * mean[2]
                x, y, turn = (elapsed_s * mean).tolist()
                cos, sin = math.cos(heading), math.sin(heading)
                self._pose = self._pose + (x * cos - y * sin, x * sin + y * cos, turn)
            elif elapsed_s <= 0.0:
                return
        self._last = stamp_ns, twist


def planar_pose(position: Any, rotation: Any) -> np.ndarray | None:
    """Position and the direction of x from above ``(3,)``; None where they are no numbers."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    size = x * x + y * y + z * z + w * w
    if not (math.isfinite(position.x) and math.isfinite(position.y) and 1e-12 < size < math.inf):
        return None
    yaw = math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.array([position.x, position.y, yaw])
