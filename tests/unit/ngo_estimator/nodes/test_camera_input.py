"""What the node of a camera refuses before it starts, and what it takes from a calibration, without ROS."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.process import StartError
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.nodes.camera_input import CameraInput
from ngo_estimator.nodes.messages import to_time
from ngo_estimator.nodes.settings import LocalNodeSettings, MapNodeSettings
from ngo_estimator.nodes.weights import weights_folder


def test_a_camera_has_no_map() -> None:
    with pytest.raises(StartError, match="camera has no weights, and no map"):
        weights_folder(MapNodeSettings(world="camera"))


class Robot:
    """Calls an input as its topics would, and keeps what it publishes, logs and drops."""

    def __init__(self, robot_odometry: str = "topic") -> None:
        self.published: list[RelativeStep | None] = []
        self.said: list[str] = []
        self.dropped: list[str] = []
        self._topics: dict[str, Callable[[Any], None]] = {}
        logger = SimpleNamespace(info=self.said.append, warning=self.said.append)
        nobody = SimpleNamespace(get_subscription_count=lambda: 0)
        node: Any = SimpleNamespace(
            resolve_topic_name="/{}".format, get_logger=lambda: logger, create_publisher=lambda *_, **__: nobody
        )
        status: Any = SimpleNamespace(received=lambda stamp_ns: None, dropped=self._drop)
        listening: Any = SimpleNamespace(to=self._listen, to_all=self._listen)
        settings = LocalNodeSettings(
            world="camera", robot_odometry=robot_odometry, robot_odometry_topic="wheels", image_topic="camera/image_raw"
        )
        self.input = CameraInput(node, settings, self.published.append)
        self.input.listen(listening, status)

    def _listen(self, kind: type, topic: str, callback: Callable[[Any], None], *_: Any) -> None:
        self._topics["/" + topic.strip("/")] = callback

    def _drop(self, kind: str, reason: object, count: int = 1) -> None:
        self.dropped += [f"{kind}: {reason}"] * count

    def calibrate(self, focal: float, frame: str = "") -> None:
        message = CameraInfo(width=160, height=120, distortion_model="plumb_bob")
        message.header.frame_id = frame
        message.k = np.array((focal, 0.0, 80.0, 0.0, focal, 60.0, 0.0, 0.0, 1.0))
        self._topics["/camera/camera_info"](message)

    def mount(self, frame: str, parent: str, height_m: float, topic: str = "/tf_static") -> None:
        each = TransformStamped(child_frame_id=frame)
        each.header.frame_id, each.transform.translation.z, each.transform.rotation.w = parent, height_m, 1.0
        self._topics[topic](TFMessage(transforms=[each]))

    def see(self, stamp_s: float, wheels_s: float | None = None) -> None:
        wheels, picture = Odometry(), Image(width=160, height=120, encoding="mono8", step=160, data=bytes(160 * 120))
        picture.header.stamp, picture.header.frame_id = to_time(round(stamp_s * 1e9)), "base_link"
        wheels.header.stamp = to_time(round((stamp_s if wheels_s is None else wheels_s) * 1e9))
        if "/wheels" in self._topics:
            self._topics["/wheels"](wheels)
        self._topics["/camera/image_raw"](picture)


def test_a_camera_in_the_frame_of_the_robot_is_mounted_and_a_new_calibration_begins_anew() -> None:
    robot = Robot()
    robot.calibrate(100.0)
    robot.see(1.0)
    robot.see(1.1)
    assert [step is None for step in robot.published] == [False] and "'base_link' on 'base_link'" in robot.said[-1]
    assert not any("transform" in line for line in robot.input.problems())
    robot.calibrate(100.0)
    assert len(robot.published) == 1
    robot.calibrate(0.0)
    assert len(robot.published) == 1 and "not calibrated" in robot.dropped[-1]
    robot.calibrate(120.0)
    assert robot.published[1:] == [None] and "the calibration changed" in robot.said[-1]
    robot.see(1.2)
    robot.see(1.3)
    assert [step is None for step in robot.published[2:]] == [False]
    assert len([line for line in robot.said if line.startswith("camera: 160 x 120")]) == 2


def test_a_clock_that_is_wrong_is_a_problem_with_both_stamps() -> None:
    robot = Robot()
    robot.calibrate(100.0)
    for k in range(70):
        robot.see(31.0 + 0.1 * k, 1.0 + 0.1 * k)
    assert not robot.published and len(robot.dropped) == 6
    assert "6 pictures had no odometry at their stamps (newest stamp of pictures 37.900 s, of odometry 7.900 s)" in (
        robot.input.problems()
    )
    assert not robot.input.problems()


def test_without_odometry_the_height_over_the_floor_gives_the_scale_or_there_is_none() -> None:
    robot = Robot("none")
    robot.calibrate(100.0)
    robot.see(1.0)
    assert "no transform says how high the camera is over the floor (found 0 m;" in robot.dropped[-1]
    for frame, parent, height_m in (("base_link", "base_footprint", 0.3), ("camera", "base_link", 0.2)):
        robot.mount(frame, parent, height_m)
    robot.calibrate(100.0, "camera")
    robot.see(1.1)
    robot.see(1.2)
    assert [step is None for step in robot.published] == [False]
    assert "1 pictures showed too little of the floor: they have the scale of those before them, or none" in (
        robot.input.problems()
    )


@pytest.mark.parametrize(("frame", "height_m"), [("base_link", 0.3), ("camera", 0.5)])
@pytest.mark.parametrize("late", [False, True])
def test_the_floor_is_at_base_footprint_whatever_comes_above_base_link(frame: str, height_m: float, late: bool) -> None:
    robot = Robot("none")

    def see(stamp_s: float) -> None:
        robot.calibrate(100.0, frame)
        robot.see(stamp_s)

    robot.mount("camera", "base_link", 0.2)
    if late:
        see(1.0)
    robot.mount("base_link", "base_footprint", 0.3)
    see(1.1)
    robot.mount("base_link", "odom", 0.0, "/tf")
    robot.calibrate(120.0, frame)
    see(1.2)
    core = robot.input._core
    assert core is not None and core.model.centre[2] == pytest.approx(height_m)
    assert ("the camera's mounting came late" in "".join(robot.said)) == (late and frame == "camera")
    problems = robot.input.problems()
    assert not any("robot_odometry:=tf" in line for line in problems)
    assert any("set base_frame:=base_footprint" in line for line in problems)


def test_odometry_on_tf_that_is_not_used_is_a_problem() -> None:
    robot = Robot("none")
    robot.mount("camera", "base_link", 0.2)
    robot.mount("base_link", "odom", 0.0, "/tf")
    robot.calibrate(100.0, "camera")
    robot.see(1.0)
    assert "'odom' -> 'base_link' is on TF already: robot_odometry:=tf uses it" in robot.input.problems()
