"""Node that turns images or laser scans into relative poses, odometry and odom -> base_link."""

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from nav_msgs.msg import Odometry
from ngo_msgs.msg import RelativePose
from ngo_msgs.srv import Reset
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import StartError, run_node
from ngo_common.nodes.qos import checked_overrides, overridable
from ngo_common.settings import usage
from ngo_estimator.data.lidar_file import is_lidar, require_opencv, require_torch
from ngo_estimator.geometry.planar_covariance import position_std, propagate
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.step_messages import OdometryWriter, TransformsWriter
from ngo_estimator.nodes.weights import weights_folder

if TYPE_CHECKING:
    from ngo_estimator.data.relative_step import RelativeStep
    from ngo_estimator.nodes.camera_input import CameraInput
    from ngo_estimator.nodes.image_input import ImageInput
    from ngo_estimator.nodes.lidar_input import LidarInput

NAME = "local_node"
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
        self._covariance = np.zeros((3, 3))
        self._input = self._make_input(settings)
        # A robot that publishes odom -> base_link goes on with it: then only map -> odom is ours.
        self._has_odom = settings.robot_odometry == "tf"
        with checked_overrides():
            self._create_topics()
        self.create_service(Reset, "~/reset", self._on_reset)
        self._live.on_change(self._on_settings)
        self._live.lock()
        self.get_logger().info(f"ready: {self.get_fully_qualified_name()}, {settings.world}, {self._input.description}")

    def _make_input(self, settings: LocalNodeSettings) -> "ImageInput | LidarInput | CameraInput":
        # Imported here because torch takes seconds: a bad parameter is said at once, and a lidar needs no torch.
        if settings.uses_camera:
            _need(require_opencv)
            from ngo_estimator.nodes.camera_input import CameraInput

            return CameraInput(self, settings, self._publish)
        if is_lidar(weights_folder(settings)):
            from ngo_estimator.nodes.lidar_input import LidarInput

            return LidarInput(self, settings, self._publish)
        if settings.robot_odometry != "none":
            raise StartError(
                f"parameter 'robot_odometry' is '{settings.robot_odometry}'; expected 'none': these weights take images"
            )
        _need(require_torch)
        from ngo_estimator.nodes.image_input import ImageInput

        return ImageInput(self, settings, self._publish)

    def _create_topics(self) -> None:
        settings = self._settings
        self._status = NodeStatus(self, settings, self._details, self._problems)
        self._relative_pose = self._publisher(RelativePose, settings.relative_pose_topic, settings.relative_pose_depth)
        odom_frame, base_frame = settings.framed(settings.odom_frame), settings.framed(settings.base_frame)
        if settings.publish_odometry and not self._has_odom:
            self._odometry = self._publisher(Odometry, settings.odometry_topic)
            self._odometry_writer = OdometryWriter(odom_frame, base_frame, serialize_message)
        if settings.publish_tf and not self._has_odom:
            self._tf = self._publisher(TFMessage, settings.tf_topic)
            self._tf_writer = TransformsWriter([(odom_frame, base_frame)], serialize_message)
        self._listening = Listening(self, self._status, settings.source_timeout_s)
        self._input.listen(self._listening, self._status)

    def _publisher(self, message_type: type, topic: str, depth: int = _DEPTH) -> Publisher:
        return self.create_publisher(message_type, topic, depth, qos_overriding_options=overridable())

    def _publish(self, estimate: "RelativeStep | None") -> None:
        if estimate is None:
            self._covariance = np.zeros((3, 3))
            return
        settings = self._settings
        if not self._has_odom:
            estimate = replace(estimate, robot_odom_xyyaw=None)
        frame = settings.framed(settings.base_frame)
        self._relative_pose.publish(messages.relative_pose_message(estimate, frame))
        self._covariance = propagate(
            self._covariance, estimate.odom_xyyaw, estimate.relative_xyyaw, estimate.covariance
        )
        if settings.publish_odometry and not self._has_odom:
            self._odometry.publish(self._odometry_writer.write(estimate, self._covariance))
        if settings.publish_tf and not self._has_odom:
            self._tf.publish(self._tf_writer.write(estimate.stamp_ns, estimate.odom_xyyaw))

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        response.success, response.message = True, self._input.reset()
        return response

    def _on_settings(self, settings: LocalNodeSettings) -> None:
        self._settings = settings
        self._status.set_period(settings.diagnostics_period_s)
        self._listening.set_timeout(settings.source_timeout_s)

    def _details(self) -> dict[str, str]:
        deviation = f"{position_std(self._covariance):.3g}"
        return {**self._input.details(), "standard deviation of the position (m)": deviation}

    def _problems(self) -> list[str]:
        return [*self._listening.problems(), *self._input.problems()]


def _need(require: Callable[[], None]) -> None:
    """Raise ``StartError`` where a library is missing."""
    try:
        require()
    except ValueError as error:
        raise StartError(str(error)) from error


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, LocalNode, usage("ngo_estimator", NAME, _SUMMARY, LocalNodeSettings)))


if __name__ == "__main__":
    main()
