"""What messages say: planar poses and stamps."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ngo_estimator.nodes.messages import to_ns


def xyyaw(message: Any) -> np.ndarray:
    """The planar pose ``(3,)`` of a Pose or a Transform, or of a message with a pose and its covariance."""
    pose = message.pose.pose if hasattr(message, "pose") else message
    is_pose = hasattr(pose, "position")
    where, turned = (pose.position, pose.orientation) if is_pose else (pose.translation, pose.rotation)
    return np.array((where.x, where.y, 2.0 * np.arctan2(turned.z, turned.w)))


def stamps_ns(messages: Iterable[Any]) -> list[int]:
    """The stamps of the messages."""
    return [to_ns(message.header.stamp) for message in messages]
