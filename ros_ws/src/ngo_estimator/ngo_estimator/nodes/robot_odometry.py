"""The robot's own odometry as a node hears it: on TF or on a topic, beside all other transforms."""

from collections.abc import Callable

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from ngo_estimator.nodes import messages
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_recordings.odometry_poses import OdometryPoses
from ngo_recordings.transform_buffer import FramePoses, TransformBuffer

_DEPTH = 1000
_NO_POSE = "pose has values that are not finite, or no orientation"


class RobotOdometry:
    """Subscribes to the robot's odometry and to transforms, and hands poses on; bad ones are dropped with a word.

    Args:
        take: takes the stamp (ns) and the pose ``(3,)`` of the base frame; raises ``ValueError`` about what it refuses.
        on_transforms: called after transforms came, with whether they are static.
        on_odometry: called after a pose came on a topic.
    """

    def __init__(
        self,
        node: Node,
        settings: LocalNodeSettings,
        take: Callable[[int, np.ndarray], None],
        on_transforms: Callable[[bool], None],
        on_odometry: Callable[[], None],
    ) -> None:
        self._node, self._settings = node, settings
        self._take, self._on_transforms, self._on_odometry = take, on_transforms, on_odometry
        self.base_frame = settings.framed(settings.base_frame)
        self.odom_frame = settings.framed(settings.odom_frame)
        self.transforms, self.fixed = TransformBuffer(), TransformBuffer()  # all, and those of /tf_static alone
        self._wheels = FramePoses(self.transforms, self.odom_frame, self.base_frame)
        self._poses = OdometryPoses()

    @property
    def description(self) -> str:
        """Where the odometry comes from, in words."""
        return {
            "none": "no odometry of the robot",
            "topic": f"odometry on '{self._node.resolve_topic_name(self._settings.robot_odometry_topic)}'",
            "tf": f"odometry from {self.odom_frame} to {self.base_frame} on TF",
        }[self._settings.robot_odometry]

    def listen(self, listening: Listening, status: NodeStatus) -> None:
        """Subscribe to odometry and transforms."""
        self._status, settings = status, self._settings
        if settings.robot_odometry == "topic":
            poses = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy[settings.image_reliability.upper()])
            listening.to(Odometry, settings.robot_odometry_topic, self._read, poses)
        # Every node on a robot publishes transforms: no single publisher is held on to.
        listening.to_all(TFMessage, settings.tf_topic, self._read_moving, QoSProfile(depth=_DEPTH))
        latched = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        listening.to_all(TFMessage, settings.tf_topic + "_static", self._read_static, latched)

    def add(self, stamp_ns: int, pose_xyyaw: np.ndarray) -> None:
        """Hand on a pose ``(3,)``; one that is refused is dropped."""
        try:
            self._take(stamp_ns, pose_xyyaw)
        except ValueError as error:
            self._status.dropped("robot odometry", error)

    def _read_static(self, message: TFMessage) -> None:
        self.fixed.take(message.transforms, static=True)
        self._read_transforms(message, static=True)

    def _read_moving(self, message: TFMessage) -> None:
        self._read_transforms(message, static=False)

    def _read_transforms(self, message: TFMessage, static: bool) -> None:
        bad, on_tf = self._wheels.bad, self._settings.robot_odometry == "tf"
        for stamp_ns, pose in self._wheels.read(message.transforms, static):
            if on_tf:
                self.add(stamp_ns, pose.planar()[0])
        if self._wheels.bad > bad and on_tf:
            self._status.dropped("robot odometry", _NO_POSE)
        self._on_transforms(static)

    def _read(self, message: Odometry) -> None:
        try:
            pose = self._poses.read(message)
        except ValueError as error:
            self._status.dropped("robot odometry", error)
            return
        if pose is None:
            self._status.dropped("robot odometry", _NO_POSE)
            return
        self.add(messages.to_ns(message.header.stamp), pose)
        self._on_odometry()
