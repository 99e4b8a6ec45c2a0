"""The yaw rate in the messages of an IMU, about the robot's own z."""

from __future__ import annotations

from typing import Any

import numpy as np

from ngo_recordings.mounting import find_pose
from ngo_recordings.poses import Pose
from ngo_recordings.recording import Recording
from ngo_recordings.topics import RecordingTopics

_UP = np.array((0.0, 0.0, 1.0))


def up_axis(pose: Pose | None) -> np.ndarray:
    """The robot's z in the axes of an IMU that sits so on it ``(3,)``; the IMU's own z where its pose is not known."""
    return _UP if pose is None else pose.rotation.as_matrix()[2]


def recorded_up_axis(recording: Recording, topics: RecordingTopics) -> np.ndarray:
    """The same by the transforms of a recording, for its topics.imu."""
    frame = str(recording.first(str(topics.imu)).value.header.frame_id).strip("/")
    found = find_pose(recording, topics, frame) if frame else None
    return up_axis(None if found is None else found[2])


def yaw_rate(message: Any, up: np.ndarray) -> float:
    """Counter-clockwise about the axis ``up`` ``(3,)``, rad/s; not a number where the message has none."""
    rate = message.angular_velocity
    return float(up @ (rate.x, rate.y, rate.z))
