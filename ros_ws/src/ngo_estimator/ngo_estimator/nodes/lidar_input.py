"""The input of ``local_node`` with a lidar: scans, the robot's own odometry, and where the scanner sits."""

import math
from collections import defaultdict, deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, Imu, LaserScan, MultiEchoLaserScan, PointCloud2

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.intake.lidar_intake import LidarIntake
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.odometry_on_tf import OdometryOnTf
from ngo_estimator.nodes.robot_odometry import RobotOdometry
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.weights import load_core
from ngo_estimator.offline.compiling import compiling
from ngo_estimator.offline.warm_up import warm_up_odometry
from ngo_recordings.imu import up_axis, up_direction, yaw_rate
from ngo_recordings.laser_scan import LidarScan, scan_of
from ngo_recordings.mounting import Mounting as KnownMounting
from ngo_recordings.mounting import mounting_in
from ngo_recordings.space_scan import DistanceUnit, camera_matrix, cloud_scan, depth_scan, info_topic

_TYPES = {"LaserScan": LaserScan, "MultiEchoLaserScan": MultiEchoLaserScan, "PointCloud2": PointCloud2, "depth": Image}
_MOUNTING_WAIT_NS = 2_000_000_000
_MOST_HELD = 200
_MOST_READINGS = 1000


class LidarInput:
    """Subscribes to scans, to the robot's odometry and to transforms, and hands on an estimate for each scan.

    Scans wait for the scanner's mounting for 2 s at most, by their stamps; then it is taken to be the base frame, until
    it comes: then the odometry starts anew with it.

    Args:
        publish: takes each estimate, and None where the odometry starts anew.
    """

    def __init__(self, node: Node, settings: LocalNodeSettings, publish: Callable[[RelativeStep | None], None]) -> None:
        self._node, self._settings, self._publish = node, settings, publish
        self._core = LidarIntake(load_core(MixtureLidar.load, settings), self._mounting_of, settings.min_range)
        with compiling(node.get_logger().info):
            warm_up_odometry()
        self._robot = RobotOdometry(node, settings, self._core.add_wheels, self._on_transforms, self._update)
        self._on_tf = OdometryOnTf(self._robot.transforms, self._robot.odom_frame, self._robot.base_frame)
        self._said = ""
        self._infos: dict[str, CameraInfo] = {}
        self._units: defaultdict[str, DistanceUnit] = defaultdict(DistanceUnit)
        self._held: deque[LidarScan] = deque(maxlen=_MOST_HELD)
        self._mountings: dict[str, KnownMounting | None] = {}  # by frame; None: taken to be the base frame
        self._topics = settings.scan_topics or (settings.scan_topic,)
        self._restarts = 0
        self._unsure = self._newly_unsure = 0

    @property
    def description(self) -> str:
        """What the input listens to, in words."""
        topics = "', '".join(map(self._node.resolve_topic_name, self._topics))
        return f"{self._settings.scan_type} on '{topics}', {self._robot.description}"

    def listen(self, listening: Listening, status: NodeStatus) -> None:
        """Subscribe to scans, odometry and the scanner's mounting."""
        self._status, settings = status, self._settings
        reliability = ReliabilityPolicy[settings.image_reliability.upper()]
        scans = QoSProfile(depth=settings.image_depth, reliability=reliability)
        for topic in self._topics:
            # Each scanner on a topic may have a driver of its own.
            listening.to(_TYPES[settings.scan_type], topic, partial(self._on_scan, topic), scans, each_frame=True)
            if settings.scan_type == "depth":
                listening.to_all(CameraInfo, info_topic(topic), partial(self._on_info, topic), scans)
        self._robot.listen(listening, status)
        if settings.robot_odometry != "none":  # an IMU alone does not know the way
            readings = QoSProfile(depth=_MOST_READINGS, reliability=ReliabilityPolicy.BEST_EFFORT)
            listening.to_all(Imu, settings.imu_topic, self._on_imu, readings)

    def _on_imu(self, message: Imu) -> None:
        frame = message.header.frame_id.strip("/")
        pose = self._robot.transforms.newest_lookup(self._robot.base_frame, frame)
        stamp_ns, rate_rps = messages.to_ns(message.header.stamp), yaw_rate(message, up_axis(pose))
        self._core.add_imu(stamp_ns, rate_rps, up_direction(message, pose))

    def _on_transforms(self, static: bool) -> None:
        for frame, known in list(self._mountings.items()):
            if static or known is None:
                self._look_for_mounting(frame)
        self._update()

    def _on_info(self, topic: str, message: CameraInfo) -> None:
        if topic not in self._infos or camera_matrix(message).size:
            self._infos[topic] = message

    def _on_scan(self, topic: str, message: LaserScan | MultiEchoLaserScan | PointCloud2 | Image) -> None:
        try:
            if isinstance(message, PointCloud2):
                scan = cloud_scan(message, topic, self._units[topic])
            elif isinstance(message, Image):
                scan = depth_scan(message, self._infos.get(topic), topic, self._units[topic])
            else:
                scan = scan_of(message, topic)
        except ValueError as error:
            self._status.dropped("scan", error)
            return
        self._status.received(scan.stamp_ns)
        self._held.append(scan)
        self._update()

    def _update(self) -> None:
        while self._held and self._is_mounted():
            scan = self._held.popleft()
            if scan.frame_id not in self._mountings:  # the first scanner is not held up by others
                self._status.dropped(
                    "scan", f"no transform says where '{scan.frame_id}' sits on '{self._robot.base_frame}'"
                )
                continue
            try:
                self._core.add_scan(scan)
            except ValueError as error:
                self._status.dropped("scan", error)
        while True:
            try:
                for step in self._core.ready():
                    self._take(step)
                break
            except ValueError as error:
                self._status.dropped("scan", error)
        self._hand_on()
        if self._core.restarts > self._restarts:
            self._restarts = self._core.restarts
            self._publish(None)
            self._node.get_logger().info(
                "the scans' stamps jumped back: their source restarted, so the odometry starts anew"
            )

    def _take(self, step: Any) -> None:
        self._unsure += step.unsure
        self._newly_unsure += step.unsure
        if self._settings.robot_odometry == "tf":
            self._on_tf.add(step)
        else:
            self._publish(step)

    def _hand_on(self) -> None:
        """Publish the steps whose odometry on TF is known, and say what is missing."""
        for step in self._on_tf.ready(self._core.lag_s):
            self._publish(step)
        for line in self._core.news():
            self._node.get_logger().info(line)
        held = self._held if self._settings.robot_odometry == "tf" else ()
        problem = self._on_tf.problem([scan.stamp_ns for scan in held])
        if problem and not self._said:
            self._node.get_logger().warning(problem)
        self._said = problem

    def _is_mounted(self) -> bool:
        """Whether the mounting of the next scan's scanner is known by now, or has been waited for long enough."""
        frame = self._held[0].frame_id
        if frame not in self._mountings:
            self._look_for_mounting(frame)
        if self._mountings:
            return True
        if self._held[-1].stamp_ns - self._held[0].stamp_ns < _MOUNTING_WAIT_NS and len(self._held) < _MOST_HELD:
            return False
        self._node.get_logger().warning(
            f"{self._settings.tf_topic}_static does not say where '{frame}' sits on '{self._robot.base_frame}': it is "
            "taken to be there, looking ahead, until a transform says it"
        )
        self._mountings[frame] = None
        return True

    def _look_for_mounting(self, frame: str) -> None:
        """Take the mounting that the transforms say by now, if it is news."""
        if frame in ("", self._robot.base_frame):
            self._mountings[frame] = None
            return
        found = mounting_in(self._robot.transforms, self._robot.base_frame, frame, self._settings.tf_topic)
        known = self._mountings.get(frame)
        if found is None or (known is not None and found.near(known)):
            return
        self._node.get_logger().info(f"scanner: {found}")
        before, again = self._mounting_of(frame), frame in self._mountings
        self._mountings[frame] = found
        if again and known is None and not _same(before, self._mounting_of(frame)):
            self.reset()
            self._node.get_logger().warning("the scanner's mounting came late: the odometry starts anew with it")
        elif again:
            self._core.remount()

    def _mounting_of(self, frame: str) -> Mounting:
        """Where the scanner of a frame sits: as TF says, else at the base frame, looking ahead."""
        found = self._mountings.get(frame)
        sensor = np.zeros(3) if found is None else found.base_from_scan_xyyaw.copy()
        if self._settings.scan_yaw_deg != 0.0 and frame == next(iter(self._mountings), frame):
            sensor[2] = math.radians(self._settings.scan_yaw_deg)
        return Mounting(sensor) if found is None else Mounting(sensor, found.upside_down, found.height_m)

    def reset(self) -> str:
        """Start anew with the next scan; returns what that means, in words."""
        self._core.reset()
        self._held.clear()
        self._on_tf.reset()
        self._publish(None)
        return "the next scan is the new origin of the odometry"

    def details(self) -> dict[str, str]:
        """Values for diagnostics."""
        return {
            "scans waiting for odometry": str(self._core.waiting + len(self._held) + self._on_tf.waiting),
            "scanner": "; ".join(
                f"'{frame}' not on TF" if at is None else str(at) for frame, at in self._mountings.items()
            ),
            "robot odometry": "heard" if self._core.has_wheels else "none",
            "age of scans against odometry (s)": f"{self._core.lag_s:.3f}",
            "yaw of the scanner against its mounting (deg)": f"{math.degrees(self._core.mounting_yaw_rad):.1f}",
            "scans that did not say where they were taken": str(self._unsure),
            "restarts": str(self._core.restarts),
            "remarks": "; ".join(self._core.remarks()),
        }

    def problems(self) -> list[str]:
        """A line for each thing that was wrong since the last call."""
        found = []
        if self._newly_unsure:
            found.append(f"{self._newly_unsure} scans did not say where they were taken: the motion was predicted")
            self._newly_unsure = 0
        if self._settings.robot_odometry != "none" and not self._core.has_wheels:
            found.append("no odometry of the robot came yet")
        for frame, known in self._mountings.items():
            if known is None and frame not in ("", self._robot.base_frame):
                found.append(f"no transform says where '{frame}' sits on '{self._robot.base_frame}'")
        found += self._core.problems()
        found += [self._said] if self._said else []
        return found


def _same(one: Mounting, other: Mounting) -> bool:
    off = one.sensor_xyyaw - other.sensor_xyyaw
    return one.upside_down == other.upside_down and bool((np.abs(off) < 0.01).all())
