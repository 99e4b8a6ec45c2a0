"""Velocities from outside for a simulated robot, and the collisions that they lead to."""

from __future__ import annotations

from collections.abc import Callable

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped, Twist
from rclpy.node import Node
from rclpy.qos import QoSProfile

from ngo_sim.convex_shapes import Floats
from ngo_sim.nodes.outputs import Outputs

TOPIC = "cmd_vel"


class VelocityInput:
    """Passes each `cmd_vel` on, and publishes where the robot began to touch something as `collision`."""

    def __init__(self, node: Node, outputs: Outputs, command: Callable[[float, float], None]) -> None:
        """Begin to listen; command takes a speed (m/s) and a turn rate (rad/s), and raises ValueError for bad ones."""
        self._node, self._command = node, command
        self._collision = outputs.create(PointStamped, "collision")
        self._touched = False
        node.create_subscription(Twist, TOPIC, self._on_command, QoSProfile(depth=10))

    def publish(self, blocked: bool, pose_xyyaw: Floats, stamp: Time, frame: str) -> None:
        """Publish the robot's place once something blocks it, and not again until it has come free."""
        if blocked and not self._touched:
            message = PointStamped()
            message.header.stamp, message.header.frame_id = stamp, frame
            message.point.x, message.point.y = float(pose_xyyaw[0]), float(pose_xyyaw[1])
            self._collision.publish(message)
        self._touched = blocked

    def _on_command(self, message: Twist) -> None:
        try:
            self._command(message.linear.x, message.angular.z)
        except ValueError as error:
            self._node.get_logger().warning(f"{TOPIC} dropped: {error}", throttle_duration_sec=5.0)
