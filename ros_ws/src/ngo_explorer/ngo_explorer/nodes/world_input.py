"""What the explorer hears: the map and its changes, the pose, its deviation, and whether the robot is lost."""

from __future__ import annotations

import math
import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from ngo_explorer.known_map import Cells, Floats, KnownMap
from ngo_explorer.nodes.settings import ExploreNodeSettings
from ngo_explorer.nodes.transforms import TransformTree, yaw_of

_LOST = ("lost:", "not localised")  # in the message of a status
_TURNED_RAD = 1e-3


class WorldInput:
    """Holds the newest of everything."""

    def __init__(self, node: Node, settings: ExploreNodeSettings) -> None:
        self._node, self._settings = node, settings
        self._tree = TransformTree()
        self._heard_s = -math.inf
        self._pose: Floats | None = None
        self._pose_s = 0.0  # by its stamp
        self.deviation_m = -1.0
        """Standard deviation of the position; -1 where nobody says it."""
        self._lost = ""
        self._whole: tuple[Cells, float, Floats] | None = None
        self._changed = False
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        static = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(OccupancyGrid, settings.map_topic, self._on_map, latched)
        node.create_subscription(OccupancyGridUpdate, settings.map_topic + "_updates", self._on_update, 10)
        node.create_subscription(TFMessage, "/tf", self._on_tf, 100)
        node.create_subscription(TFMessage, "/tf_static", lambda message: self._tree.take(message, static=True), static)
        node.create_subscription(PoseWithCovarianceStamped, settings.pose_topic, self._on_pose, 10)
        node.create_subscription(DiagnosticArray, settings.diagnostics_topic, self._on_diagnostics, 10)

    @property
    def has_map(self) -> bool:
        """Whether a map has come."""
        return self._whole is not None

    @property
    def pose_xyyaw(self) -> Floats | None:
        """The newest pose of the robot in the map; None where there is none, or an old one."""
        if time.monotonic() - self._heard_s > self._settings.pose_timeout_s:
            return None
        return self._pose

    def late_s(self, now_s: float) -> float:
        """How old the pose is by its stamp; 0 where that is more than a pose may be: then it is of another clock."""
        late_s = now_s - self._pose_s
        return late_s if 0.0 < late_s < self._settings.pose_timeout_s else 0.0

    @property
    def doubt(self) -> str:
        """Why the robot does not know where it is; empty: it does."""
        if self.pose_xyyaw is None:
            return "there is no new pose"
        if self._lost:
            return self._lost
        if self.deviation_m > self._settings.deviation_m:
            return f"the position has a deviation of {self.deviation_m:.2f} m"
        return ""

    def give_map(self, known: KnownMap) -> None:
        """Let an exploration have the newest map, if it has changed; raises ValueError where it cannot take it."""
        if self._whole is not None and (self._changed or known.empty):
            self._changed = False
            known.update(*self._whole)

    def _on_map(self, message: OccupancyGrid) -> None:
        info, origin = message.info, message.info.origin
        values = np.array(message.data, np.int8)
        if values.size != info.width * info.height or not values.size or abs(yaw_of(origin.orientation)) > _TURNED_RAD:
            self._dropped("a map", "it is empty, of another size than it says, or turned in its frame")
            return
        corner = np.array((origin.position.x, origin.position.y))
        self._whole = values.reshape(info.height, info.width), float(info.resolution), corner
        self._changed = True

    def _on_update(self, message: OccupancyGridUpdate) -> None:
        if self._whole is None:
            return
        values, rows, columns = self._whole[0], slice(message.y, message.y + message.height), message.x + message.width
        part = np.array(message.data, np.int8)
        inside = message.x >= 0 and message.y >= 0 and rows.stop <= values.shape[0] and columns <= values.shape[1]
        if not inside or part.size != message.width * message.height:
            self._dropped("a part of a map", "it is outside of the map, or of another size than it says")
            return
        values[rows, message.x : columns] = part.reshape(message.height, message.width)
        self._changed = True

    def _on_tf(self, message: TFMessage) -> None:
        self._tree.take(message)
        settings = self._settings
        found = self._tree.pose(settings.framed(settings.map_frame), settings.framed(settings.base_frame))
        # The base's own branch tells that the robot is heard of: map -> odom may come seldom.
        if found is not None:
            (self._pose, self._pose_s), self._heard_s = found, time.monotonic()

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        covariance = np.array(message.pose.covariance).reshape(6, 6)[:2, :2]
        largest = float(np.linalg.eigvalsh(covariance)[-1]) if np.isfinite(covariance).all() else math.inf
        self.deviation_m = math.sqrt(max(0.0, largest))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(self._settings.localisation_node):
                self._lost = status.message if any(word in status.message for word in _LOST) else ""

    def _dropped(self, what: str, why: str) -> None:
        self._node.get_logger().warning(f"dropped {what}: {why}", throttle_duration_sec=5.0)
