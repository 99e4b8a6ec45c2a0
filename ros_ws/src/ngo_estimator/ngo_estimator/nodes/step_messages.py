"""The messages that both nodes publish about a step as bytes, written by numpy: much cheaper than by objects."""

import math
import struct
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ngo_estimator.geometry.planar_covariance import to_spatial
from ngo_estimator.nodes import messages

if TYPE_CHECKING:  # a node imports the cores after checking its parameters
    from ngo_estimator.data.relative_step import RelativeStep
    from ngo_estimator.slam.trajectory_update import TrajectoryUpdate

ODOMETRY, POSE, TF = "/odom", "/ngo/pose", "/tf"
TYPES = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    TF: "tf2_msgs/msg/TFMessage",
}
"""Types of the topics."""

Serialise = Callable[[Any], bytes]  # Turns a message into bytes.

_NS = 1_000_000_000
_HEAD = 4  # Bytes that say how a message is encoded: a stamp, or the number of transforms, comes behind them.


class OdometryWriter:
    """Writes ``messages.odometry_message`` of one step after the other.

    The first message is serialised, as a template. In CDR all others differ from it in their stamps and in the doubles
    behind the names alone. So it is with the writers below.

    Args:
        odom_frame, base_frame: names of the frames.
    """

    def __init__(self, odom_frame: str, base_frame: str, serialise: Serialise) -> None:
        self._frames, self._serialise = (odom_frame, base_frame), serialise
        self._message = bytearray()

    def write(self, step: "RelativeStep", covariance: np.ndarray) -> bytes:
        """The odometry with its covariance ``(3, 3)``, and the mean velocity of the step."""
        if not self._message:
            self._message += self._serialise(messages.odometry_message(step, covariance, *self._frames))
        seconds = (step.stamp_ns - step.from_stamp_ns) / _NS
        twist = np.zeros(6)
        twist[[0, 1, 5]] = step.relative_xyyaw / seconds
        parts = _pose(step.odom_xyyaw), to_spatial(covariance), twist, to_spatial(step.covariance / seconds**2)
        return _filled(self._message, step.stamp_ns, *parts)


class PoseWriter:
    """Writes ``messages.pose_message`` in one frame."""

    def __init__(self, frame: str, serialise: Serialise) -> None:
        self._frame, self._serialise = frame, serialise
        self._message = bytearray()

    def write(self, stamp_ns: int, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> bytes:
        """A pose ``(3,)`` with its covariance ``(3, 3)``."""
        if not self._message:
            self._message += self._serialise(messages.pose_message(stamp_ns, self._frame, pose_xyyaw, covariance))
        return _filled(self._message, stamp_ns, _pose(pose_xyyaw), to_spatial(covariance))


class TransformsWriter:
    """Writes the same transforms again and again, as ``messages.transform_message`` does.

    Args:
        frames: parent and child of each transform.
    """

    def __init__(self, frames: Sequence[tuple[str, str]], serialise: Serialise) -> None:
        self._message, self._ends = bytearray(), [2 * _HEAD]
        message = messages.transform_message(0, *frames[0], np.zeros(3))
        message.transforms = []
        for parent, child in frames:
            message.transforms += messages.transform_message(0, parent, child, np.zeros(3)).transforms
            self._message[:] = serialise(message)
            self._ends.append(len(self._message))

    def write(self, stamp_ns: int, *parents_from_children: np.ndarray) -> bytes:
        """Each transform ``(3,)``, all with one stamp."""
        stamp = _stamp(stamp_ns)
        for begin, end, xyyaw in zip(self._ends[:-1], self._ends[1:], parents_from_children, strict=True):
            values = _pose(xyyaw).tobytes()
            self._message[begin : begin + len(stamp)], self._message[end - len(values) : end] = stamp, values
        return bytes(self._message)


class StepMessages:
    """Writes the odometry, the pose and the transforms of one step after the other.

    Args:
        base_frame, odom_frame, map_frame: names of the frames.
        serialise: turns a message into bytes, given the name of its type.
    """

    def __init__(
        self, base_frame: str, odom_frame: str, map_frame: str, serialise: Callable[[Any, str], bytes]
    ) -> None:
        self._odometry = OdometryWriter(odom_frame, base_frame, lambda message: serialise(message, TYPES[ODOMETRY]))
        self._pose = PoseWriter(map_frame, lambda message: serialise(message, TYPES[POSE]))
        frames = (map_frame, odom_frame), (odom_frame, base_frame)
        self._transforms = TransformsWriter(frames, lambda message: serialise(message, TYPES[TF]))

    def of(self, step: "RelativeStep", odom_covariance: np.ndarray, update: "TrajectoryUpdate") -> dict[str, bytes]:
        """The message of each topic; ``odom_covariance`` ``(3, 3)`` is that of the step's end in the odometry."""
        return {
            ODOMETRY: self._odometry.write(step, odom_covariance),
            POSE: self._pose.write(step.stamp_ns, update.pose_xyyaw, update.covariance),
            TF: self._transforms.write(step.stamp_ns, update.map_from_odom_xyyaw, step.tf_odom_xyyaw),
        }


def _filled(message: bytearray, stamp_ns: int, *ends: np.ndarray) -> bytes:
    """The message with this stamp at its beginning and these doubles at its end."""
    stamp, values = _stamp(stamp_ns), b"".join(part.tobytes() for part in ends)
    message[_HEAD : _HEAD + len(stamp)], message[-len(values) :] = stamp, values
    return bytes(message)


def _stamp(stamp_ns: int) -> bytes:
    return struct.pack("<iI", *divmod(stamp_ns, _NS))


def _pose(pose_xyyaw: np.ndarray) -> np.ndarray:
    """Position and quaternion ``(7,)`` of a pose ``(3,)``."""
    x, y, yaw = pose_xyyaw.tolist()
    return np.array((x, y, 0.0, 0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)))
