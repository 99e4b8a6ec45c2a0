"""Node that turns images and actions into relative poses, odometry and odom -> base_link."""

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction, RelativePose
from ngo_msgs.srv import Reset
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage

from ngo_estimator.nodes import messages
from ngo_estimator.nodes.inputs import Input
from ngo_estimator.nodes.parameters import BadParameter, LiveSettings
from ngo_estimator.nodes.process import run_node
from ngo_estimator.nodes.qos import overridable
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.weights import load_core
from ngo_estimator.planar_covariance import position_std, propagate

if TYPE_CHECKING:
    from ngo_estimator.local_odometry import LocalEstimate

NAME = "local_node"
_ACTIONS = (DiscreteAction.FORWARD, DiscreteAction.TURN_LEFT, DiscreteAction.TURN_RIGHT)
_DEPTH = 100


class LocalNode(Node):
    """Subscribes images and actions; publishes relative poses, odometry and odom -> base_link."""

    def __init__(self) -> None:
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        self._live = LiveSettings(self, LocalNodeSettings)
        self._settings = settings = self._live.values
        # Imported here because torch takes seconds: a bad parameter is said at once.
        from ngo_estimator.frame_pairing import FramePairing
        from ngo_estimator.local_odometry import LocalOdometry

        self._core = load_core(LocalOdometry.load, settings)
        self._pairing = FramePairing(
            self._core.uses_action, int(settings.action_timeout_s * 1e9), settings.action_capacity
        )
        self._covariance = np.zeros((3, 3))
        self._missed = self._newly_missed = 0
        self._inputs: list[Input] = []
        try:
            self._create_topics()
        except InvalidQosOverridesError as error:
            raise BadParameter(str(error)) from error
        self.create_service(Reset, "~/reset", self._on_reset)
        self._live.on_change(self._on_settings)
        self._live.lock()
        self.get_logger().info(f"ready: {settings.world}, images {self._core.image_shape}")

    def _create_topics(self) -> None:
        settings = self._settings
        self._status = NodeStatus(
            self, settings.diagnostics_topic, settings.diagnostics_period_s, self._details, self._problems
        )
        self._relative_pose = self._publisher(RelativePose, settings.relative_pose_topic, settings.relative_pose_depth)
        if settings.publish_odometry:
            self._odometry = self._publisher(Odometry, settings.odometry_topic)
        if settings.publish_tf:
            self._tf = self._publisher(TFMessage, settings.tf_topic)
        reliability = ReliabilityPolicy[settings.image_reliability.upper()]
        image_qos = QoSProfile(depth=settings.image_depth, reliability=reliability)
        self._listen(Image, settings.image_topic, self._on_image, image_qos)
        if self._core.uses_action:
            self._listen(DiscreteAction, settings.action_topic, self._on_action, QoSProfile(depth=10 * _DEPTH))

    def _publisher(self, message_type: type, topic: str, depth: int = _DEPTH) -> Publisher:
        return self.create_publisher(message_type, topic, depth, qos_overriding_options=overridable())

    def _listen(self, message_type: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> None:
        """Take stamped messages of one publisher, which its frame tells from others."""
        timeout_s = self._settings.source_timeout_s
        self._inputs.append(
            Input(self, self._status, message_type, topic, qos, callback, lambda m: m.header.frame_id, timeout_s)
        )

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
                with self._status.timed("time an update"):
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
        odom_frame, base_frame = settings.framed(settings.odom_frame), settings.framed(settings.base_frame)
        self._relative_pose.publish(messages.relative_pose_message(estimate, base_frame))
        self._covariance = propagate(
            self._covariance, estimate.odom_xyyaw, estimate.relative_xyyaw, estimate.covariance
        )
        self._missed += estimate.missed_frames
        self._newly_missed += estimate.missed_frames
        if settings.publish_odometry:
            self._odometry.publish(messages.odometry_message(estimate, self._covariance, odom_frame, base_frame))
        if settings.publish_tf:
            stamped = (estimate.stamp_ns, odom_frame, base_frame, estimate.odom_xyyaw)
            self._tf.publish(messages.transform_message(*stamped))

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        self._core.reset()
        self._pairing.reset()
        response.success, response.message = True, "the next image is the new origin of the odometry"
        return response

    def _on_settings(self, settings: LocalNodeSettings) -> None:
        self._settings = settings
        self._status.set_period(settings.diagnostics_period_s)
        for entry in self._inputs:
            entry.set_timeout(settings.source_timeout_s)

    def _details(self) -> dict[str, str]:
        return {
            "images waiting for actions": str(self._pairing.waiting),
            "missed frames": str(self._missed),
            "restarts": str(self._core.restarts),
            "standard deviation of the position (m)": f"{position_std(self._covariance):.3g}",
        }

    def _problems(self) -> list[str]:
        found = [line for entry in self._inputs for line in entry.problems()]
        if self._newly_missed:
            found.append(f"{self._newly_missed} frames missing between images, bridged with a larger covariance")
            self._newly_missed = 0
        return found


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, LocalNode))


if __name__ == "__main__":
    main()
