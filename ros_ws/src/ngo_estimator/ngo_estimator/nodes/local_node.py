"""Node that turns images or laser scans into relative poses, odometry and odom -> base_link."""

import math
import sys
import traceback
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction, RelativePose
from ngo_msgs.srv import Reset
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import StartError, run_node
from ngo_common.nodes.qos import checked_overrides, overridable
from ngo_common.settings import usage
from ngo_estimator.geometry.planar_covariance import position_std, propagate
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.inputs import Input
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.weights import load_core

if TYPE_CHECKING:
    from ngo_estimator.odometry.local_odometry import LocalEstimate

NAME = "local_node"
_ACTIONS = (DiscreteAction.FORWARD, DiscreteAction.TURN_LEFT, DiscreteAction.TURN_RIGHT)
_TWISTS = {"TwistStamped": TwistStamped, "Twist": Twist, "Odometry": Odometry}
_DEPTH = 100
_SUMMARY = "Publishes relative poses, odometry and odom -> base_link from images or laser scans."


class LocalNode(Node):
    """Publishes relative poses, odometry and odom -> base_link.

    It subscribes to the inputs of the networks in its weights: images or laser scans; actions, velocities or neither.
    """

    def __init__(self) -> None:
        super().__init__(NAME)
        self._live = LiveSettings(self, LocalNodeSettings)
        self._settings = settings = self._live.values
        # Imported here because torch takes seconds: a bad parameter is said at once.
        from ngo_estimator.nodes.sensors import sensor_array, sensor_topic
        from ngo_estimator.odometry.frame_pairing import FramePairing
        from ngo_estimator.odometry.local_odometry import LocalOdometry

        self._core = load_core(LocalOdometry.load, settings)
        image_format = self._core.image_format
        topics = settings.image_topic, settings.scan_topic
        try:
            self._sensor_type, topic = sensor_topic(image_format, *topics, settings.image_transport == "compressed")
        except ValueError as error:
            raise StartError(f"parameter 'image_transport': {error}") from error
        self._sensor_topic, self._sensor = topic, "scan" if image_format.is_scan else "image"
        self._observe: Callable[[Any], np.ndarray] = partial(
            sensor_array, image_format=image_format, topic=topic, scan_yaw_rad=math.radians(settings.scan_yaw_deg)
        )
        self._pairing = FramePairing(
            self._core.uses_action,
            int(settings.action_timeout_s * 1e9),
            settings.action_capacity,
            self._core.uses_twist,
            int(settings.twist_tolerance_s * 1e9),
        )
        self._covariance = np.zeros((3, 3))
        self._missed = self._newly_missed = 0
        self._inputs: list[Input] = []
        with checked_overrides():
            self._create_topics()
        self.create_service(Reset, "~/reset", self._on_reset)
        self._live.on_change(self._on_settings)
        self._live.lock()
        kind, topic = self._sensor_type.__name__, self.resolve_topic_name(self._sensor_topic)
        self.get_logger().info(f"ready: {self.get_fully_qualified_name()}, {settings.world}, {kind} on '{topic}'")

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
        self._listen(self._sensor_type, self._sensor_topic, self._on_sensor, image_qos)
        if self._core.uses_action:
            self._listen(DiscreteAction, settings.action_topic, self._on_action, QoSProfile(depth=10 * _DEPTH))
        if self._core.uses_twist:
            twist = _TWISTS[settings.twist_type]
            self._listen(twist, settings.twist_topic, self._on_twist, QoSProfile(depth=10 * _DEPTH))

    def _publisher(self, message_type: type, topic: str, depth: int = _DEPTH) -> Publisher:
        return self.create_publisher(message_type, topic, depth, qos_overriding_options=overridable())

    def _listen(self, message_type: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> None:
        """Take the messages of one publisher; their frames, where they have any, tell publishers apart."""
        timeout_s = self._settings.source_timeout_s

        def take(message: Any) -> None:
            try:
                callback(message)
            except Exception as error:
                # A fault of ours, not of the message: a robot is better off with a gap than without the node.
                reason = f"internal error, {type(error).__name__}: {' '.join(str(error).split())}"
                self._status.dropped(f"message on '{topic}'", reason)
                self.get_logger().debug(traceback.format_exc())

        self._inputs.append(Input(self, self._status, message_type, topic, qos, take, _frame_of, timeout_s))

    def _on_sensor(self, message: Any) -> None:
        stamp_ns = messages.to_ns(message.header.stamp)
        try:
            self._pairing.add_frame(stamp_ns, self._observe(message))
        except ValueError as error:
            self._status.dropped(self._sensor, error)
            return
        self._status.received(stamp_ns)
        self._update()

    def _on_action(self, message: DiscreteAction) -> None:
        if message.action not in _ACTIONS:
            self._status.dropped("action", f"action is {message.action}; expected one of {_ACTIONS}")
            return
        self._pairing.add_action(messages.to_ns(message.header.stamp), message.action)
        self._update()

    def _on_twist(self, message: Twist | TwistStamped | Odometry) -> None:
        stamp_ns, twist_xyyaw = messages.stamped_twist(message, self.get_clock().now().nanoseconds)
        try:
            self._pairing.add_twist(stamp_ns, twist_xyyaw)
        except ValueError as error:
            self._status.dropped("twist", error)
            return
        self._update()

    def _update(self) -> None:
        dropped, restarts = self._pairing.dropped, self._core.restarts
        for pair in self._pairing.ready():
            try:
                with self._status.timed("time an update"):
                    estimate = self._core.update(pair.stamp_ns, pair.image, pair.action, pair.twist)
            except ValueError as error:
                self._status.dropped(self._sensor, error)
                continue
            if estimate is None:
                self._covariance = np.zeros((3, 3))
            else:
                self._publish(estimate)
        if self._pairing.dropped > dropped:
            told = [f"action on '{self._settings.action_topic}'"] if self._core.uses_action else []
            told += [f"velocity on '{self._settings.twist_topic}'"] if self._core.uses_twist else []
            kind = f"{self._sensor} without {'action' if self._core.uses_action else 'velocity'}"
            reason = f"the {' or the '.join(told)} that led to it did not come"
            self._status.dropped(kind, reason, self._pairing.dropped - dropped)
        if self._core.restarts > restarts:
            self.get_logger().info(
                f"the {self._sensor}s' stamps jumped back: their source restarted, so the odometry starts anew"
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
            f"{self._sensor}s waiting for {'velocities' if self._core.uses_twist else 'actions'}": str(
                self._pairing.waiting
            ),
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


def _frame_of(message: Any) -> str:
    return message.header.frame_id if hasattr(message, "header") else ""


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, LocalNode, usage("ngo_estimator", NAME, _SUMMARY, LocalNodeSettings)))


if __name__ == "__main__":
    main()
