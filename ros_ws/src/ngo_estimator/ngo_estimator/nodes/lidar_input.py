"""The input of ``local_node`` with a lidar: scans, the robot's own odometry, and where the scanner sits."""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.lidar.front_ends import load_front_end
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.weights import load_core
from ngo_estimator.offline.compiling import compiling
from ngo_estimator.offline.warm_up import warm_up_odometry
from ngo_recordings.association import ros_pose
from ngo_recordings.mounting import mounting_in
from ngo_recordings.poses import TransformTree
from ngo_recordings.scan_stream import LidarScan, scan_of

_DEPTH = 1000
_MOUNTING_WAIT_NS = 2_000_000_000
_MOST_HELD = 200


class LidarInput:
    """Subscribes to scans, to the robot's odometry and to /tf_static, and hands on an estimate for each scan.

    Scans wait for the scanner's mounting for 2 s at most, by their stamps; then it is taken to be the base frame.

    Args:
        publish: takes each estimate, and None where the odometry starts anew.
    """

    def __init__(self, node: Node, settings: LocalNodeSettings, publish: Callable[[RelativeStep | None], None]) -> None:
        self._node, self._settings, self._publish = node, settings, publish
        self._core = load_core(load_front_end, settings)
        with compiling(node.get_logger().info):
            warm_up_odometry()
        self._base_frame = settings.framed(settings.base_frame)
        self._odom_frame = settings.framed(settings.odom_frame)
        self._static = TransformTree(0)
        self._held: deque[LidarScan] = deque(maxlen=_MOST_HELD)
        self._mounted = settings.scan_yaw_deg != 0.0
        if self._mounted:
            self._core.mounting = Mounting(np.array([0.0, 0.0, math.radians(settings.scan_yaw_deg)]))
        self._restarts = 0
        self._unsure = self._newly_unsure = 0

    @property
    def description(self) -> str:
        """What the input listens to, in words."""
        own = {
            "none": "no odometry of the robot",
            "topic": f"odometry on '{self._node.resolve_topic_name(self._settings.robot_odometry_topic)}'",
            "tf": f"odometry from {self._odom_frame} to {self._base_frame} on TF",
        }[self._settings.robot_odometry]
        return f"LaserScan on '{self._node.resolve_topic_name(self._settings.scan_topic)}', {own}"

    def listen(self, listening: Listening, status: NodeStatus) -> None:
        """Subscribe to scans, odometry and the scanner's mounting."""
        self._status, settings = status, self._settings
        reliability = ReliabilityPolicy[settings.image_reliability.upper()]
        listening.to(
            LaserScan,
            settings.scan_topic,
            self._on_scan,
            QoSProfile(depth=settings.image_depth, reliability=reliability),
        )
        if settings.robot_odometry == "topic":
            listening.to(Odometry, settings.robot_odometry_topic, self._on_odometry, QoSProfile(depth=_DEPTH))
        # Every node on a robot publishes transforms: no single publisher is held on to.
        if settings.robot_odometry == "tf":
            listening.to_all(TFMessage, settings.tf_topic, self._on_tf, QoSProfile(depth=_DEPTH))
        latched = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        listening.to_all(TFMessage, settings.tf_topic + "_static", self._on_static, latched)

    def _on_static(self, message: TFMessage) -> None:
        for each in message.transforms:
            pose = ros_pose(each.transform.translation, each.transform.rotation)
            if pose is not None:
                self._static.add(each.header.frame_id.strip("/"), each.child_frame_id.strip("/"), 0, pose, static=True)
        self._update()

    def _on_scan(self, message: LaserScan) -> None:
        try:
            scan = scan_of(message, self._settings.scan_topic)
        except ValueError as error:
            self._status.dropped("scan", error)
            return
        self._status.received(scan.stamp_ns)
        self._held.append(scan)
        self._update()

    def _on_odometry(self, message: Odometry) -> None:
        pose = message.pose.pose
        self._add_wheels(messages.to_ns(message.header.stamp), pose.position, pose.orientation)

    def _on_tf(self, message: TFMessage) -> None:
        for each in message.transforms:
            if (each.header.frame_id.strip("/"), each.child_frame_id.strip("/")) == (
                self._odom_frame,
                self._base_frame,
            ):
                transform = each.transform
                self._add_wheels(messages.to_ns(each.header.stamp), transform.translation, transform.rotation)

    def _add_wheels(self, stamp_ns: int, position: Any, orientation: Any) -> None:
        pose = ros_pose(position, orientation)
        if pose is None:
            self._status.dropped("robot odometry", "pose has values that are not finite, or no orientation")
            return
        try:
            self._core.add_wheels(stamp_ns, pose.planar()[0])
        except ValueError as error:
            self._status.dropped("robot odometry", error)
            return
        self._update()

    def _update(self) -> None:
        while self._held and (self._mounted or self._find_mounting()):
            try:
                self._core.add_scan(self._held.popleft())
            except ValueError as error:
                self._status.dropped("scan", error)
        while True:
            try:
                for step in self._core.ready():
                    self._take(step)
                break
            except ValueError as error:
                self._status.dropped("scan", error)
        if self._core.restarts > self._restarts:
            self._restarts = self._core.restarts
            self._publish(None)
            self._node.get_logger().info(
                "the scans' stamps jumped back: their source restarted, so the odometry starts anew"
            )

    def _take(self, step: Any) -> None:
        self._unsure += step.unsure
        self._newly_unsure += step.unsure
        self._publish(step)

    def _find_mounting(self) -> bool:
        """Whether the mounting of the scanner is known by now, or has been waited for long enough."""
        frame, base = self._held[0].frame_id.strip("/"), self._base_frame
        found = mounting_in(self._static, base, frame)
        if found is not None:
            self._core.mounting = Mounting(found.base_from_scan_xyyaw, found.upside_down)
            self._node.get_logger().info(f"scanner: {found}")
        elif frame not in ("", base):
            if self._held[-1].stamp_ns - self._held[0].stamp_ns < _MOUNTING_WAIT_NS and len(self._held) < _MOST_HELD:
                return False
            self._node.get_logger().warning(
                f"/tf_static does not say where '{frame}' sits on '{base}': it is taken to be there, looking ahead"
            )
        self._mounted = True
        return True

    def reset(self) -> str:
        """Start anew with the next scan; returns what that means, in words."""
        self._core.reset()
        self._held.clear()
        self._publish(None)
        return "the next scan is the new origin of the odometry"

    def details(self) -> dict[str, str]:
        """Values for diagnostics."""
        return {
            "scans waiting for odometry": str(self._core.waiting + len(self._held)),
            "robot odometry": "heard" if self._core.has_wheels else "none",
            "age of scans against odometry (s)": f"{self._core.lag_s:.3f}",
            "yaw of the scanner against its mounting (deg)": f"{math.degrees(self._core.mounting_yaw_rad):.1f}",
            "scans that did not say where they were taken": str(self._unsure),
            "restarts": str(self._core.restarts),
        }

    def problems(self) -> list[str]:
        """A line for each thing that was wrong since the last call."""
        found = []
        if self._newly_unsure:
            found.append(f"{self._newly_unsure} scans did not say where they were taken: the motion was predicted")
            self._newly_unsure = 0
        if self._settings.robot_odometry != "none" and not self._core.has_wheels:
            found.append("no odometry of the robot came yet")
        return found
