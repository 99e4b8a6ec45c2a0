"""Node that turns images and actions into relative poses, odometry and odom -> base_link."""

import sys
from typing import TYPE_CHECKING

import numpy as np
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction, RelativePose
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage

from ngo_estimator.nodes import messages
from ngo_estimator.nodes.parameters import declare_settings
from ngo_estimator.nodes.process import run_node
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.weights import load_core
from ngo_estimator.planar_covariance import propagate

if TYPE_CHECKING:
    from ngo_estimator.local_odometry import LocalEstimate

NAME = "local_node"
_ACTIONS = (DiscreteAction.FORWARD, DiscreteAction.TURN_LEFT, DiscreteAction.TURN_RIGHT)
_DEPTH = 100


class LocalNode(Node):
    """Subscribes images and actions; publishes relative poses, odometry and odom -> base_link."""

    def __init__(self) -> None:
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        self._settings = settings = declare_settings(self, LocalNodeSettings)
        # Imported here because torch takes seconds: a bad parameter is said at once.
        from ngo_estimator.frame_pairing import FramePairing
        from ngo_estimator.local_odometry import LocalOdometry

        self._core = load_core(LocalOdometry.load, settings)
        self._pairing = FramePairing(
            self._core.uses_action, int(settings.action_timeout_s * 1e9), settings.action_capacity
        )
        self._covariance = np.zeros((3, 3))
        self._status = NodeStatus(self, settings.diagnostics_topic, settings.diagnostics_period_s, self._details)
        self._relative_pose = self.create_publisher(
            RelativePose, settings.relative_pose_topic, settings.relative_pose_depth
        )
        if settings.publish_odometry:
            self._odometry = self.create_publisher(Odometry, settings.odometry_topic, _DEPTH)
        if settings.publish_tf:
            self._tf = self.create_publisher(TFMessage, settings.tf_topic, _DEPTH)
        reliability = ReliabilityPolicy[settings.image_reliability.upper()]
        image_qos = QoSProfile(depth=settings.image_depth, reliability=reliability)
        self.create_subscription(Image, settings.image_topic, self._on_image, image_qos)
        if self._core.uses_action:
            self.create_subscription(DiscreteAction, settings.action_topic, self._on_action, 10 * _DEPTH)
        self.get_logger().info(f"ready: {settings.world}, images {self._core.image_shape}")

    def _on_image(self, message: Image) -> None:
        stamp_ns = messages.to_ns(message.header.stamp)
        try:
            image = messages.image_array(message, self._core.image_shape, self._core.image_dtype)
            self._pairing.add_frame(stamp_ns, image)
        except ValueError as error:
            self._status.dropped("image", error)
            return
        self._status.received(stamp_ns)
        self._update()

    def _on_action(self, message: DiscreteAction) -> None:
        if message.action not in _ACTIONS:
            self._status.dropped("action", f"action is {message.action}; expected one of {_ACTIONS}")
            return
        self._pairing.add_action(messages.to_ns(message.header.stamp), message.action)
        self._update()

    def _update(self) -> None:
        dropped, restarts = self._pairing.dropped, self._core.restarts
        for pair in self._pairing.ready():
            try:
                with self._status.timed():
                    estimate = self._core.update(pair.stamp_ns, pair.image, pair.action)
            except ValueError as error:
                self._status.dropped("image", error)
                continue
            if estimate is None:
                self._covariance = np.zeros((3, 3))
            else:
                self._publish(estimate)
        if self._pairing.dropped > dropped:
            reason = f"the action on '{self._settings.action_topic}' that led to it did not come"
            self._status.dropped("image without action", reason, self._pairing.dropped - dropped)
        if self._core.restarts > restarts:
            self.get_logger().info(
                "the images' stamps jumped back: their source restarted, so the odometry starts anew"
            )

    def _publish(self, estimate: "LocalEstimate") -> None:
        settings = self._settings
        self._relative_pose.publish(messages.relative_pose_message(estimate, settings.base_frame))
        self._covariance = propagate(
            self._covariance, estimate.odom_xyyaw, estimate.relative_xyyaw, estimate.covariance
        )
        if settings.publish_odometry:
            self._odometry.publish(
                messages.odometry_message(estimate, self._covariance, settings.odom_frame, settings.base_frame)
            )
        if settings.publish_tf:
            stamped = (estimate.stamp_ns, settings.odom_frame, settings.base_frame, estimate.odom_xyyaw)
            self._tf.publish(messages.transform_message(*stamped))

    def _details(self) -> dict[str, str]:
        return {
            "images waiting for actions": str(self._pairing.waiting),
            "restarts": str(self._core.restarts),
        }


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, LocalNode))


if __name__ == "__main__":
    main()
