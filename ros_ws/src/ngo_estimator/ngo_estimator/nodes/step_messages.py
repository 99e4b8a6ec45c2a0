"""The messages that both nodes publish about a step as bytes, written by numpy: much cheaper than by objects."""

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.planar_covariance import to_spatial
from ngo_estimator.nodes import messages
from ngo_estimator.online.trajectory_update import TrajectoryUpdate

ODOMETRY, POSE, TF = "/odom", "/ngo/pose", "/tf"
TYPES = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    TF: "tf2_msgs/msg/TFMessage",
}
"""Types of the topics."""

_NS = 1_000_000_000
_STAMP_AT = {ODOMETRY: 4, POSE: 4, TF: 8}
"""Behind the four bytes that say how a message is encoded, and the number of transforms."""


class StepMessages:
    """Writes the odometry, the pose and the transforms of one step after the other.

    The first step's messages are serialised, as templates. In CDR those of all others differ from them in their stamps
    and in the doubles behind the names alone.

    Args:
        base_frame, odom_frame, map_frame: names of the frames.
        serialise: turns a message into bytes, given the name of its type.
    """

    def __init__(
        self, base_frame: str, odom_frame: str, map_frame: str, serialise: Callable[[Any, str], bytes]
    ) -> None:
        self._base, self._odom, self._map, self._serialise = base_frame, odom_frame, map_frame, serialise
        self._templates: dict[str, bytearray] = {}
        self._upper_ends = 0  # bytes up to the end of the first transform

    def of(self, step: RelativeStep, odom_covariance: np.ndarray, update: TrajectoryUpdate) -> dict[str, bytes]:
        """The message of each topic; ``odom_covariance`` ``(3, 3)`` is that of the step's end in the odometry."""
        if not self._templates:
            plain = self.plain(step, odom_covariance, update)
            self._templates = {name: bytearray(self._serialise(of, TYPES[name])) for name, of in plain.items()}
            plain[TF].transforms = plain[TF].transforms[:1]
            self._upper_ends = len(self._serialise(plain[TF], TYPES[TF]))
        stamp = struct.pack("<iI", *divmod(step.stamp_ns, _NS))
        seconds = (step.stamp_ns - step.from_stamp_ns) / _NS
        twist = np.zeros(6)
        twist[[0, 1, 5]] = step.relative_xyyaw / seconds
        twist_covariance = to_spatial(step.covariance / seconds**2)
        ends: dict[str, tuple[np.ndarray, ...]] = {
            ODOMETRY: (_pose(step.odom_xyyaw), to_spatial(odom_covariance), twist, twist_covariance),
            POSE: (_pose(update.pose_xyyaw), to_spatial(update.covariance)),
            TF: (_pose(step.tf_odom_xyyaw),),
        }
        for topic, doubles in ends.items():
            message, values, at = self._templates[topic], b"".join(part.tobytes() for part in doubles), _STAMP_AT[topic]
            message[at : at + len(stamp)], message[-len(values) :] = stamp, values
        transforms, upper, values = self._templates[TF], self._upper_ends, _pose(update.map_from_odom_xyyaw).tobytes()
        transforms[upper - len(values) : upper], transforms[upper : upper + len(stamp)] = values, stamp
        return {topic: bytes(message) for topic, message in self._templates.items()}

    def plain(self, step: RelativeStep, odom_covariance: np.ndarray, update: TrajectoryUpdate) -> dict[str, Any]:
        """The same as objects: the slow definition of what ``of`` writes."""
        transforms = messages.transform_message(step.stamp_ns, self._map, self._odom, update.map_from_odom_xyyaw)
        below = messages.transform_message(step.stamp_ns, self._odom, self._base, step.tf_odom_xyyaw)
        transforms.transforms = [*transforms.transforms, *below.transforms]
        return {
            ODOMETRY: messages.odometry_message(step, odom_covariance, self._odom, self._base),
            POSE: messages.pose_message(step.stamp_ns, self._map, update.pose_xyyaw, update.covariance),
            TF: transforms,
        }


def _pose(pose_xyyaw: np.ndarray) -> np.ndarray:
    """Position and quaternion ``(7,)`` of a pose ``(3,)``."""
    x, y, yaw = pose_xyyaw
    return np.array((x, y, 0.0, 0.0, 0.0, np.sin(0.5 * yaw), np.cos(0.5 * yaw)))
