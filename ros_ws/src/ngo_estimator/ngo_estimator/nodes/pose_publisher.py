"""The newest pose and map -> odom as messages."""

from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.serialization import serialize_message
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.qos import overridable
from ngo_estimator.nodes.settings import NgoNodeSettings
from ngo_estimator.nodes.step_messages import PoseWriter, TransformsWriter

if TYPE_CHECKING:
    from ngo_estimator.slam.tf_smoothing import SmoothedCorrection

_DEPTH = 100


class PosePublisher:
    """Publishes the newest pose, and map -> odom where the node does, smoothed."""

    def __init__(
        self,
        node: LifecycleNode,
        settings: Callable[[], NgoNodeSettings],
        smoothing: "SmoothedCorrection",
        built: ExitStack,
    ) -> None:
        """Make the publishers, which end with ``built``; ``smoothing`` may be replaced."""
        self._settings, self.smoothing = settings, smoothing

        def publisher(message_type: type, topic: str) -> LifecyclePublisher:
            made = node.create_lifecycle_publisher(message_type, topic, _DEPTH, qos_overriding_options=overridable())
            built.callback(node.destroy_lifecycle_publisher, made)
            return made

        topics = settings()
        self._pose = publisher(PoseWithCovarianceStamped, topics.pose_topic)
        self._tf = publisher(TFMessage, topics.tf_topic) if topics.publish_tf else None
        self._odom_frame = topics.framed(topics.odom_frame)
        self.use_map(topics.framed(topics.map_frame))

    def use_map(self, frame: str) -> None:
        """Publish in another map's frame from now on."""
        self.map_frame = frame
        self._pose_writer = PoseWriter(frame, serialize_message)
        self._tf_writer = TransformsWriter([(frame, self._odom_frame)], serialize_message)
        self.smoothing.reset()

    def publish(
        self,
        stamp_ns: int,
        pose: np.ndarray,
        covariance: np.ndarray,
        map_from_odom: np.ndarray,
        odom: np.ndarray | None,
    ) -> None:
        """Publish a pose ``(3,)`` and its covariance ``(3, 3)`` in map, and what goes to ``send_transform``."""
        self.send_transform(stamp_ns, map_from_odom, odom)
        self._pose.publish(self._pose_writer.write(stamp_ns, pose, covariance))

    def send_transform(self, stamp_ns: int, map_from_odom: np.ndarray, odom: np.ndarray | None) -> None:
        """Publish map -> odom ``(3,)``, smoothed, with the robot's pose ``(3,)`` in odom; None: nothing."""
        if self._tf is None or odom is None:
            return
        smoothed = self.smoothing.update(stamp_ns, map_from_odom, odom)
        ahead_ns = round(1e9 * self._settings().tf_ahead_s)
        self._tf.publish(self._tf_writer.write(stamp_ns + ahead_ns, smoothed))
