"""The yaw rate in the messages of an IMU, about the robot's own z, and where up is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ngo_recordings.mounting import find_pose
from ngo_recordings.poses import Pose
from ngo_recordings.topics import RecordingTopics

if TYPE_CHECKING:  # live nodes need no files
    from ngo_recordings.recording import Recording

_UP = np.array((0.0, 0.0, 1.0))

_NEARLY = 0.01
"""How far the square of a quaternion's length may be from 1; drivers without orientation leave all numbers 0."""


def up_axis(pose: Pose | None) -> np.ndarray:
    """The robot's z in the axes of an IMU that sits so on it ``(3,)``; the IMU's own z where its pose is not known."""
    return _UP if pose is None else pose.rotation.as_matrix()[2]


def recorded_pose(recording: Recording, topics: RecordingTopics) -> Pose | None:
    """Where the IMU of topics.imu sits on the robot, by the transforms of a recording; None where none says it."""
    frame = str(recording.first(str(topics.imu)).value.header.frame_id).strip("/")
    found = find_pose(recording, topics, frame) if frame else None
    return None if found is None else found[2]


def yaw_rate(message: Any, up: np.ndarray) -> float:
    """Counter-clockwise about the axis ``up`` ``(3,)``, rad/s; not a number where the message has none."""
    rate = message.angular_velocity
    return float(up @ (rate.x, rate.y, rate.z))


def up_direction(message: Any, pose: Pose | None) -> np.ndarray | None:
    """The world's up in the axes of the robot ``(3,)``, on which the IMU sits at a pose; None where the message has no
    orientation."""
    q = message.orientation
    size = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if message.orientation_covariance[0] == -1.0 or not abs(size - 1.0) < _NEARLY:
        return None
    up = np.array((q.x * q.z - q.w * q.y, q.y * q.z + q.w * q.x, 0.5 * size - q.x * q.x - q.y * q.y)) * (2.0 / size)
    return up if pose is None else pose.rotation.apply(up)
