"""The input of ``local_node`` with a calibrated camera: pictures, their CameraInfo, odometry, and the mounting."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from ngo_common.nodes.qos import overridable
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.calibrated_camera import NOT_MOUNTED, calibrated_camera
from ngo_estimator.frontend.camera.picture_odometry import SCALELESS, PictureOdometry
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.robot_odometry import RobotOdometry
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_recordings.calibration import Calibration, calibration_of, info_topics
from ngo_recordings.images import COMPRESSED_TYPE, IMAGE_TYPE, picture
from ngo_recordings.mounting import FLOOR_FRAME
from ngo_recordings.poses import Pose

_MOUNTING_WAIT_NS = 2_000_000_000
_MOST_HELD, _MOST_GIVEN, _DEPTH = 64, 1000, 10
_SAME_HEIGHT_M = 0.001


class CameraInput:
    """Subscribes to pictures, their calibration, the robot's odometry and transforms; hands on a step for each picture.

    Pictures wait for the calibration, and for the camera's mounting for 2 s at most, by their stamps; then it is taken
    to be at the robot's own place, until it comes: then the odometry starts anew with it.

    Args:
        publish: takes each step, and None where the odometry starts anew.
    """

    def __init__(self, node: Node, settings: LocalNodeSettings, publish: Callable[[RelativeStep | None], None]) -> None:
        cv2.setNumThreads(settings.threads)
        self._node, self._settings, self._publish = node, settings, publish
        self._robot = RobotOdometry(node, settings, self._add_wheels, self._on_transforms, self._update)
        self._by_floor = settings.robot_odometry == "none"
        self._is_compressed = settings.image_transport == "compressed"
        self._topic = settings.image_topic + ("/compressed" if self._is_compressed else "")
        self._calibration: Calibration | None = None
        self._said: tuple[Any, ...] | None = None  # by the CameraInfo that counts, and its topic
        self._picture_frame = ""
        self._core: PictureOdometry | None = None
        self._mounted = False  # as transforms say
        self._unused: bool | None = None  # odometry of the robot was on TF before ours, which has the same frames
        self._held: deque[tuple[int, np.ndarray]] = deque(maxlen=_MOST_HELD)
        self._given: deque[tuple[int, np.ndarray]] = deque(maxlen=_MOST_GIVEN)  # odometry before there is a core
        self._restarts = self._newly_alone = self._unplaced = self._jumps = 0
        self._newly_unplaced = self._newly_jumped = self._newly_floorless = 0

    @property
    def description(self) -> str:
        """What the input listens to, in words."""
        scale = ": scale from the camera's height over the floor" if self._by_floor else ""
        return f"pictures on '{self._node.resolve_topic_name(self._topic)}', {self._robot.description}{scale}"

    @property
    def _info_topics(self) -> tuple[str, ...]:
        return info_topics(self._node.resolve_topic_name(self._topic), self._is_compressed)

    def listen(self, listening: Listening, status: NodeStatus) -> None:
        """Subscribe to pictures, their calibration, odometry and transforms."""
        self._status, settings = status, self._settings
        reliability = ReliabilityPolicy[settings.image_reliability.upper()]
        pictures = QoSProfile(depth=settings.image_depth, reliability=reliability)
        listening.to(CompressedImage if self._is_compressed else Image, self._topic, self._on_picture, pictures)
        for topic in self._info_topics:
            listening.to_all(CameraInfo, topic, partial(self._on_info, topic), pictures)
        self._robot.listen(listening, status)
        self._points = self._node.create_publisher(
            PointCloud2, settings.points_topic, _DEPTH, qos_overriding_options=overridable()
        )

    def _on_info(self, topic: str, message: CameraInfo) -> None:
        arrays = (np.asarray(values, np.float64).tobytes() for values in (message.k, message.p, message.d))
        size = message.height, message.width
        said = topic, *size, message.distortion_model, message.header.frame_id, *arrays
        if said == self._said or (self._said is not None and self._said[0] != topic):
            return
        try:
            self._calibration = calibration_of(message, topic, self._node.resolve_topic_name(self._topic))
        except ValueError as error:
            self._status.dropped("calibration", error)
            return
        self._said = said
        if self._core is not None:
            self._begin_anew("the calibration changed")
        self._update()

    def _begin_anew(self, why: str) -> None:
        self._core = None
        self._publish(None)
        self._node.get_logger().warning(f"{why}: the odometry starts anew with it")

    def _on_transforms(self, static: bool) -> None:
        may_be_late = not self._mounted or (self._by_floor and static)
        if self._core is not None and may_be_late and (mounting := self._mounting()) is not None:
            rise_m = abs(mounting.position[2] - self._core.model.centre[2])
            if not self._mounted or rise_m > _SAME_HEIGHT_M:
                self._begin_anew("the camera's mounting came late")
        self._update()

    def _add_wheels(self, stamp_ns: int, pose_xyyaw: np.ndarray) -> None:
        if self._core is None:
            self._given.append((stamp_ns, pose_xyyaw))
            return
        self._core.add_wheels(stamp_ns, pose_xyyaw)

    def _on_picture(self, message: Any) -> None:
        kind, known = (COMPRESSED_TYPE if self._is_compressed else IMAGE_TYPE), self._calibration
        try:
            pixels = picture(message, kind, self._topic, None if known is None else (known.height, known.width))[0]
        except ValueError as error:
            self._status.dropped("picture", error)
            return
        stamp_ns = messages.to_ns(message.header.stamp)
        self._picture_frame = message.header.frame_id.strip("/")
        self._status.received(stamp_ns)
        self._held.append((stamp_ns, pixels))
        self._update()

    def _update(self) -> None:
        if self._core is None and not self._made_core():
            return
        assert self._core is not None
        while self._held:
            try:
                self._core.add_picture(*self._held.popleft())
            except ValueError as error:
                self._status.dropped("picture", error)
            if self._core.restarts > self._restarts:
                self._restarts = self._core.restarts
                self._publish(None)
                self._node.get_logger().info("the pictures' stamps jumped back: the odometry starts anew")
        alone, floorless = self._core.by_wheels, self._core.floorless
        for step in self._core.ready():
            self._publish(step)
            if self._points.get_subscription_count():
                frame = self._settings.framed(self._settings.base_frame)
                self._points.publish(messages.points_message(step.stamp_ns, self._core.points, frame))
        self._newly_alone += self._core.by_wheels - alone
        self._newly_floorless += self._core.floorless - floorless
        if unplaced := self._core.unplaced - self._unplaced:
            self._status.dropped("picture", f"no odometry at its stamp ({self._core.clocks})", unplaced)
            self._newly_unplaced += unplaced
        self._newly_jumped += self._core.jumps - self._jumps
        self._unplaced, self._jumps = self._core.unplaced, self._core.jumps

    def _made_core(self) -> bool:
        """Whether calibration and mounting are known by now, or the mounting has been waited for long enough."""
        if self._calibration is None or not self._held:
            return False
        mounting = self._mounting()
        waited_ns = self._held[-1][0] - self._held[0][0]
        if mounting is None and waited_ns < _MOUNTING_WAIT_NS and len(self._held) < _MOST_HELD:
            return False
        if self._unused is None:
            self._unused = self._by_floor and self._robot.odom_frame in self._robot.transforms.above(
                self._robot.base_frame
            )
        frame, logger = self._frame, self._node.get_logger()
        if mounting is None:
            logger.warning(
                f"{self._settings.tf_topic}_static does not say where '{frame}' sits on '{self._robot.base_frame}': "
                f"{NOT_MOUNTED}"
            )
        try:
            model = calibrated_camera(replace(self._calibration, frame_id=frame), mounting)
            self._core = PictureOdometry(model, by_floor=self._by_floor)
        except ValueError as error:
            self._calibration = self._said = None
            self._held.clear()
            self._status.dropped("calibration", error)
            return False
        self._mounted, self._restarts, self._unplaced, self._jumps = mounting is not None, 0, 0, 0
        logger.info(
            f"camera: {model.width} x {model.height}, {model.description}, '{frame}' on '{self._robot.base_frame}'"
        )
        for stamp_ns, pose in self._given:
            self._robot.add(stamp_ns, pose)
        self._given.clear()
        return True

    @property
    def _frame(self) -> str:
        """The camera's frame, as its calibration or else its pictures say it."""
        return (self._calibration.frame_id if self._calibration is not None else "") or self._picture_frame

    def _mounting(self) -> Pose | None:
        # Of the floor static transforms alone tell: on TF our own odometry becomes the parent of the robot's frame.
        if self._by_floor:
            over_floor = self._robot.fixed.newest_lookup(self._settings.framed(FLOOR_FRAME), self._frame)
            if over_floor is not None:
                return over_floor
        if self._frame == self._robot.base_frame:
            return Pose(np.zeros(3), Rotation.identity())
        return self._robot.transforms.newest_lookup(self._robot.base_frame, self._frame) if self._frame else None

    def reset(self) -> str:
        """Start anew with the next picture; returns what that means, in words."""
        if self._core is not None:
            self._core.reset()
        self._held.clear()
        self._publish(None)
        return "the next picture is the new origin of the odometry"

    def details(self) -> dict[str, str]:
        """Values for diagnostics."""
        core = self._core
        return {
            "pictures waiting": str(len(self._held) + (0 if core is None else core.waiting)),
            "calibration": "none" if self._calibration is None else self._calibration.distortion,
            "mounting": "on TF" if self._mounted else "not on TF",
            "corners that agree": "0" if core is None else str(core.inliers),
            "restarts": str(self._restarts),
        }

    def problems(self) -> list[str]:
        """A line for each thing that was wrong since the last call."""
        found = []
        if self._core is not None and self._newly_alone:
            found.append(f"{self._newly_alone} pictures told too little: {self._core.instead}")
            self._newly_alone = 0
        if self._newly_floorless:
            found.append(f"{self._newly_floorless} pictures showed too little of the floor: {SCALELESS}")
            self._newly_floorless = 0
        if self._newly_jumped:
            found.append(f"the robot's odometry jumped {self._newly_jumped} times: the motion is guessed there")
            self._newly_jumped = 0
        if self._newly_unplaced and self._core is not None and self._core.has_wheels:
            found.append(f"{self._newly_unplaced} pictures had no odometry at their stamps ({self._core.clocks})")
        self._newly_unplaced = 0
        if self._calibration is None and self._held:
            found.append(f"no CameraInfo came on {' or '.join(self._info_topics)}, without which pictures are not used")
        if not self._by_floor and not self._given and (self._core is None or not self._core.has_wheels):
            found.append("no odometry of the robot came yet")
        if self._core is not None and not self._mounted:
            found.append(f"no transform says where the camera sits on '{self._robot.base_frame}'")
        base, odom = self._robot.base_frame, self._robot.odom_frame
        if self._unused:
            found.append(f"'{odom}' -> '{base}' is on TF already: robot_odometry:=tf uses it")
        below_floor = self._settings.framed(FLOOR_FRAME) in self._robot.fixed.above(base)[1:]
        if below_floor and self._settings.robot_odometry != "tf" and self._settings.publish_tf:
            found.append(f"'{odom}' -> '{base}' is a second parent of '{base}': set base_frame:={FLOOR_FRAME}")
        return found
