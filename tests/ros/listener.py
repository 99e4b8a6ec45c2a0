"""Subscribes to a path and counts what comes, as its own process: `python -m tests.ros.listener TOPIC`."""

import contextlib
import sys

import rclpy
from nav_msgs.msg import Path
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile


def main() -> None:
    """Run until told to end."""
    rclpy.init()
    node = rclpy.create_node("listener")
    node.create_subscription(Path, sys.argv[1], lambda path: print(len(path.poses), flush=True), QoSProfile(depth=10))
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
