"""Node that shows a running graph in the browser: map, trajectories, loops, frontiers, picture or scan, errors."""

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from ngo_msgs.msg import Trajectory
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image, LaserScan
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import StartError, run_node
from ngo_common.settings import usage
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.view_settings import ViewNodeSettings
from ngo_recordings.association import ros_pose
from ngo_recordings.images import COMPRESSED_TYPE, IMAGE_TYPE
from ngo_recordings.transform_buffer import TransformBuffer

if TYPE_CHECKING:
    from ngo_estimator.view.live_view import LiveView

NAME = "view_node"
_DEPTH = 1000
_SUMMARY = "Shows a running graph in the browser. Needs rerun: requirements/view.txt."


class ViewNode(Node):
    """Subscribes what the other nodes publish, and shows the newest of it at a limited rate."""

    def __init__(self) -> None:
        super().__init__(NAME)
        live = LiveSettings(self, ViewNodeSettings)
        self._settings = settings = live.values
        self._view = self._make_view(settings)
        self._static = TransformBuffer()
        self._newest: dict[str, Any] = {}
        self._subscribe(settings)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / settings.rate_hz, self._show, clock=steady)
        live.lock()
        self.get_logger().info(f"ready: {self.get_fully_qualified_name()}, open {self._view.url}")

    def _make_view(self, settings: ViewNodeSettings) -> "LiveView":
        try:
            from ngo_estimator.view.rerun_view import RerunView, ViewError
        except ModuleNotFoundError as error:
            if error.name != "rerun":
                raise
            raise StartError(
                "the live view needs rerun, which is not installed: pip install -r requirements/view.txt"
            ) from None
        from ngo_estimator.view.live_view import LiveView

        try:
            return LiveView(RerunView(settings.web_port, settings.data_port, settings.memory_mb, settings.open_browser))
        except ViewError as error:
            raise StartError(str(error)) from None

    def _subscribe(self, settings: ViewNodeSettings) -> None:
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        static = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        picture_type, topic = Image, settings.image_topic
        if settings.image_transport == "compressed":
            picture_type, topic = CompressedImage, f"{topic}/compressed"
        for kind, name, callback, qos in (
            (Odometry, settings.odometry_topic, self._pose_of("odometry"), _DEPTH),
            (Odometry, settings.ground_truth_topic, self._pose_of("truth"), _DEPTH),
            (TFMessage, settings.tf_topic + "_static", self._on_static, static),
            (Trajectory, settings.trajectory_topic, self._keep("trajectory"), 1),
            (PoseWithCovarianceStamped, settings.pose_topic, self._keep("pose"), newest),
            (MarkerArray, settings.loops_topic, self._keep("loops"), 1),
            (MarkerArray, settings.frontiers_topic, self._keep("frontiers"), latched),
            (Path, settings.plan_topic, self._keep("plan"), newest),
            (OccupancyGrid, settings.map_topic, self._keep("map"), latched),
            (picture_type, topic, self._keep("picture"), newest),
            (LaserScan, settings.scan_topic, self._keep("scan"), newest),
        ):
            self.create_subscription(kind, name, callback, qos)

    def _keep(self, what: str) -> Callable[[Any], None]:
        """A callback that keeps a message until it is shown, or a newer one comes."""
        return lambda message: self._newest.__setitem__(what, message)

    def _pose_of(self, name: str) -> Callable[[Odometry], None]:
        track = self._view.tracks[name]
        return lambda message: track.append(messages.to_ns(message.header.stamp), xyyaw(message.pose.pose))

    def _on_static(self, message: TFMessage) -> None:
        for each in message.transforms:
            pose = ros_pose(each.transform.translation, each.transform.rotation)
            if pose is not None:
                self._static.add(each.header.frame_id.strip("/"), each.child_frame_id.strip("/"), 0, pose, static=True)

    def _show(self) -> None:
        """Show what has come since the last time; a message that cannot be shown is named."""
        newest, self._newest = self._newest, {}
        for what, show in (
            ("pose", self._show_pose),
            ("trajectory", self._show_trajectory),
            ("loops", self._show_loops),
            ("frontiers", self._show_frontiers),
            ("plan", self._show_plan),
            ("map", self._show_map),
            ("picture", self._show_picture),
            ("scan", self._show_scan),
        ):
            if what in newest:
                try:
                    show(newest[what])
                except ValueError as error:
                    line = f"{what} is not shown: {' '.join(str(error).split())}"
                    self.get_logger().warning(line, throttle_duration_sec=5.0)

    def _show_pose(self, message: PoseWithCovarianceStamped) -> None:
        pose, covariance = messages.planar_estimate(message, message.header.frame_id)
        self._view.show_pose(messages.to_ns(message.header.stamp), pose, covariance)

    def _show_trajectory(self, message: Trajectory) -> None:
        poses = np.column_stack([message.x, message.y, message.yaw])
        self._view.show_trajectory(np.array(message.stamps_ns), poses)

    def _show_loops(self, message: MarkerArray) -> None:
        points = [[point.x, point.y] for marker in message.markers for point in marker.points]
        colors = [[color.r, color.g, color.b, color.a] for marker in message.markers for color in marker.colors]
        self._view.show_loops(np.array(points).reshape(-1, 2, 2), np.array(colors).reshape(-1, 4)[::2])

    def _show_frontiers(self, message: MarkerArray) -> None:
        points = [[point.x, point.y] for marker in message.markers for point in marker.points]
        colors = [[each.color.r, each.color.g, each.color.b] for each in message.markers for _ in each.points]
        self._view.show_frontiers(np.array(points).reshape(-1, 2), np.array(colors).reshape(-1, 3))

    def _show_plan(self, message: Path) -> None:
        points = [[pose.pose.position.x, pose.pose.position.y] for pose in message.poses]
        self._view.show_plan(np.array(points).reshape(-1, 2))

    def _show_map(self, message: OccupancyGrid) -> None:
        info = message.info
        cells = np.array(message.data, np.int8).reshape(info.height, info.width)
        self._view.show_map(cells, float(info.resolution), xyyaw(info.origin))

    def _show_picture(self, message: Image | CompressedImage) -> None:
        type_name = IMAGE_TYPE if isinstance(message, Image) else COMPRESSED_TYPE
        self._view.show_picture(message, type_name, self._settings.image_topic)

    def _show_scan(self, message: LaserScan) -> None:
        base = self._settings.framed(self._settings.base_frame)
        self._view.show_scan(message, self._settings.scan_topic, self._static, base)

    def destroy_node(self) -> None:
        """Show the last messages, then end."""
        self._show()
        self._view.close()
        super().destroy_node()


def xyyaw(pose: Any) -> np.ndarray:
    """Position and heading ``(3,)`` of a pose message."""
    q = pose.orientation
    yaw = np.arctan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
    return np.array([pose.position.x, pose.position.y, yaw])


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, ViewNode, usage("ngo_estimator", NAME, _SUMMARY, ViewNodeSettings)))


if __name__ == "__main__":
    main()
