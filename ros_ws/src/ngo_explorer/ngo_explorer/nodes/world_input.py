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
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from ngo_explorer.known_map import Cells, Floats, KnownMap
from ngo_explorer.nodes.settings import ExploreNodeSettings
from ngo_explorer.nodes.transforms import TransformTree, yaw_of
from ngo_recordings.errors import RecordingError
from ngo_recordings.laser_scan import scan_of
from ngo_recordings.mounting import mounting_in
from ngo_recordings.transform_buffer import TransformBuffer

_LOST = ("lost:", "not localised")  # in the message of a status
_TURNED_RAD = 1e-3
_NOTHING = slice(0, 0), slice(0, 0)  # rows and columns


class WorldInput:
    """Holds the newest of everything."""

    def __init__(self, node: Node, settings: ExploreNodeSettings) -> None:
        self._node, self._settings = node, settings
        self._tree = TransformTree()
        self._mountings = TransformBuffer()
        self._hits: tuple[Floats, float] | None = None
        self._heard_s = self._scan_s = -math.inf
        self._pose: Floats | None = None
        self._pose_s = 0.0  # by its stamp
        self.deviation_m = -1.0
        """Standard deviation of the position; -1 where nobody says it."""
        self._lost = ""
        self._whole: tuple[Cells, float, Floats] | None = None
        self._changed = False
        self._part: tuple[slice, slice] | None = _NOTHING  # what of it has changed; None: all may have
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        static = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(OccupancyGrid, settings.map_topic, self._on_map, latched)
        node.create_subscription(OccupancyGridUpdate, settings.map_topic + "_updates", self._on_update, 10)
        node.create_subscription(TFMessage, "/tf", self._on_tf, 100)
        node.create_subscription(TFMessage, "/tf_static", self._on_static, static)
        if settings.drive == "own":
            newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            node.create_subscription(LaserScan, settings.scan_topic, self._on_scan, newest)
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
        """How old the pose is by its stamp."""
        return self._age_s(self._pose_s, now_s)

    def new_hits(self, now_s: float) -> tuple[Floats, float] | None:
        """Hits ``(n, 2)`` of a new scan in the robot's frame, and of when; None where no new one has come."""
        hits, self._hits = self._hits, None
        return None if hits is None else (hits[0], now_s - self._age_s(hits[1], now_s))

    def _age_s(self, stamp_s: float, now_s: float) -> float:
        """0 where it is more than a pose's may be: then the stamp is of another clock."""
        age_s = now_s - stamp_s
        return age_s if 0.0 < age_s < self._settings.pose_timeout_s else 0.0

    @property
    def sees(self) -> bool:
        """Whether scans come, where this node drives by them. A robot without a scanner drives by its map alone."""
        if self._settings.drive != "own" or time.monotonic() - self._scan_s <= self._settings.pose_timeout_s:
            return True
        topic = self._settings.scan_topic
        has_scanner = self._scan_s > -math.inf or self._node.count_publishers(topic) > 0
        if not has_scanner:
            said = f"nobody publishes scans on {topic}: the robot stops before what is in its map alone"
            self._node.get_logger().warning(said, once=True)
        return not has_scanner

    @property
    def doubt(self) -> str:
        """Why the robot does not know where it is, or what is around it; empty: it does."""
        if self.pose_xyyaw is None:
            return "there is no new pose"
        if self._lost:
            return self._lost
        if self.deviation_m > self._settings.deviation_m:
            return f"the position has a deviation of {self.deviation_m:.2f} m"
        if not self.sees:
            return f"there is no new scan on {self._settings.scan_topic}"
        return ""

    def give_map(self, known: KnownMap) -> None:
        """Let an exploration have the newest map, if it has changed; raises ValueError where it cannot take it."""
        if self._whole is not None and (self._changed or known.empty):
            changed, self._changed, self._part = self._part, False, _NOTHING
            known.update(*self._whole, changed)

    def _on_map(self, message: OccupancyGrid) -> None:
        info, origin = message.info, message.info.origin
        values = np.array(message.data, np.int8)
        if values.size != info.width * info.height or not values.size or abs(yaw_of(origin.orientation)) > _TURNED_RAD:
            self._dropped("a map", "it is empty, of another size than it says, or turned in its frame")
            return
        corner = np.array((origin.position.x, origin.position.y))
        self._whole = values.reshape(info.height, info.width), float(info.resolution), corner
        self._changed, self._part = True, None

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
        if self._part is not None:
            self._part = _joined(self._part[0], rows), _joined(self._part[1], slice(message.x, columns))

    def _on_static(self, message: TFMessage) -> None:
        self._tree.take(message, static=True)
        self._mountings.take(message.transforms, static=True)

    def _on_scan(self, message: LaserScan) -> None:
        try:
            scan = scan_of(message, self._settings.scan_topic)
        except RecordingError as error:
            self._dropped("a scan", str(error))
            return
        base = self._settings.framed(self._settings.base_frame).strip("/")
        mounting = mounting_in(self._mountings, base, scan.frame_id)
        if mounting is not None:
            self._hits = mounting.on_robot(scan.hits()), 1e-9 * scan.stamp_ns
        elif scan.frame_id == base:
            self._hits = scan.hits(), 1e-9 * scan.stamp_ns
        else:
            self._dropped("a scan", f"/tf_static does not say where {scan.frame_id} sits on {base}")
            return
        self._scan_s = time.monotonic()

    def _on_tf(self, message: TFMessage) -> None:
        self._tree.take(message)
        settings = self._settings
        found = self._tree.pose(settings.framed(settings.map_frame), settings.framed(settings.base_frame))
        if found is None:
            return
        # The base's own branch tells that the robot is heard of: map -> odom may come seldom. 0: it has no stamps.
        if found[1] != self._pose_s or not found[1]:
            self._heard_s = time.monotonic()
        self._pose, self._pose_s = found

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


def _joined(one: slice, other: slice) -> slice:
    """The smallest that holds both; an empty one counts for nothing."""
    return slice(min(one.start, other.start), max(one.stop, other.stop)) if one.stop > one.start else other
