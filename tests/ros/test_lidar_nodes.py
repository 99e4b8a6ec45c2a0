"""Both estimators as real processes on a lidar's scans: its mounting and the robot's own odometry come from topics."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from ngo_msgs.msg import RelativePose
from ngo_msgs.srv import Reset
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, LaserScan
from tf2_msgs.msg import TFMessage

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.nodes.messages import to_ns, to_time, transform_message
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.association import ros_pose
from ngo_recordings.laser_scan import scan_of
from ngo_recordings.mounting import mounting_in
from ngo_recordings.transform_buffer import TransformBuffer
from tests.unit.ngo_estimator.ray_casting import ROOM, cast

from .processes import LATCHED, Diagnostics, NodeProcess, Probe
from .readings import xyyaw

pytestmark = pytest.mark.processes

FRAMES = 60
STEP_NS = 100_000_000
WARM_UP_NS, BEGIN_NS = 1_000_000_000_000, 5_000_000_000_000
UNMOUNTED = 5  # Scans that come before the scanner's mounting does.
ANGLES = np.radians(np.arange(-120.0, 120.5, 1.0))
MOUNTING = np.array([0.12, -0.05, math.radians(30.0)])
RELIABLE = {"world": "scan", "image_reliability": "reliable", "image_depth": 1000}
AHEAD_S = 0.2


def drive() -> list[np.ndarray]:
    """True poses of a robot that goes round the room, some steps of it standing."""
    poses = [np.array([1.0, 1.0, 0.0])]
    for step in range(1, FRAMES):
        speed = 0.0 if 20 <= step < 30 else 0.08
        poses.append(compose(poses[-1], np.array([speed, 0.0, 0.03 if step > 30 else 0.0])))
    return poses


def wheel_pose(true: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Wheels that see everything 4 % too long, in a frame of their own."""
    moved = between(first, true) * np.array([1.04, 1.04, 1.0])
    return compose(np.array([5.0, -3.0, 1.0]), moved)


def scan_message(true: np.ndarray, stamp_ns: int, upside_down: bool, noise: np.random.Generator) -> LaserScan:
    sign = -1.0 if upside_down else 1.0
    ranges = cast(ROOM, compose(true, MOUNTING), sign * ANGLES) + 0.005 * noise.standard_normal(len(ANGLES))
    message = LaserScan(
        angle_min=float(np.float32(ANGLES[0])),
        angle_max=float(np.float32(ANGLES[-1])),
        angle_increment=float(np.float32(np.radians(1.0))),
        range_min=float(np.float32(0.05)),
        range_max=30.0,
        ranges=ranges.astype(np.float32),
    )
    message.header.stamp, message.header.frame_id = to_time(stamp_ns), "laser"
    return message


def mounting_message(upside_down: bool) -> TFMessage:
    """Static transforms from the robot's foot to its scanner, the last with the roll of one that hangs."""
    x, y, yaw = MOUNTING.tolist()
    half = 0.5 * yaw
    turned = Quaternion(z=math.sin(half), w=math.cos(half))
    mast = TransformStamped(child_frame_id="mast")
    mast.header.frame_id = "base_link"
    mast.transform.translation, mast.transform.rotation = Vector3(x=x, y=y, z=0.2), turned
    laser = TransformStamped(child_frame_id="laser")
    laser.header.frame_id = "mast"
    laser.transform.rotation = Quaternion(x=1.0, w=0.0) if upside_down else Quaternion(w=1.0)
    foot = TransformStamped(child_frame_id="base_link")
    foot.header.frame_id = "base_footprint"
    foot.transform.translation, foot.transform.rotation = Vector3(z=0.1), Quaternion(w=1.0)
    return TFMessage(transforms=[mast, laser, foot])


def mounting_of(message: TFMessage) -> Mounting:
    """The mounting to the last digit: registration amplifies the rounding of a quaternion."""
    tree = TransformBuffer()
    for each in message.transforms:
        pose = ros_pose(each.transform.translation, each.transform.rotation)
        assert pose is not None
        tree.add(each.header.frame_id, each.child_frame_id, 0, pose, static=True)
    found = mounting_in(tree, "base_link", "laser")
    assert found is not None
    return Mounting(found.base_from_scan_xyyaw, found.upside_down)


@dataclass
class Outputs:
    relative_poses: list[RelativePose] = field(default_factory=list)
    odometry: list[Odometry] = field(default_factory=list)
    poses: list[PoseWithCovarianceStamped] = field(default_factory=list)
    transforms: list[TFMessage] = field(default_factory=list)

    def since(self, stamp_ns: int) -> "Outputs":
        """What came about this time and later."""
        stamped = (self.relative_poses, self.odometry, self.poses)
        later = ([m for m in messages if to_ns(m.header.stamp) >= stamp_ns] for messages in stamped)
        return Outputs(*later, [m for m in self.transforms if to_ns(m.transforms[0].header.stamp) >= stamp_ns])


def close(a: np.ndarray, b: np.ndarray, metres: float, degrees: float) -> bool:
    off = between(a, b)
    return bool(np.hypot(off[0], off[1]) < metres and abs(off[2]) < math.radians(degrees))


@pytest.mark.parametrize(("robot_odometry", "upside_down"), [("none", False), ("topic", True), ("tf", False)])
def test_live_nodes_follow_a_lidar(probe: Probe, robot_odometry: str, upside_down: bool) -> None:
    out = Outputs(
        probe.collect(RelativePose, "relative_pose"),
        probe.collect(Odometry, "odom"),
        probe.collect(PoseWithCovarianceStamped, "ngo/pose"),
        probe.collect(TFMessage, "/tf"),
    )
    static = probe.node.create_publisher(TFMessage, "/tf_static", LATCHED)
    scans = probe.node.create_publisher(LaserScan, "scan", 1000)
    wheels = probe.node.create_publisher(Odometry, "wheels", 1000)
    tf = probe.node.create_publisher(TFMessage, "/tf", 1000)
    imu = probe.node.create_publisher(Imu, "imu", 1000)
    settings = {**RELIABLE, "robot_odometry": robot_odometry, "robot_odometry_topic": "wheels"}
    ngo_settings: dict[str, Any] = {"world": "scan"}
    odom_frame = "odom"
    if robot_odometry == "tf":  # a robot's own names, and a chain of which the last part is static
        odom_frame = "wheels"
        settings |= {"odom_frame": odom_frame}
        ngo_settings |= {"odom_frame": odom_frame, "map_frame": "world", "tf_ahead_s": AHEAD_S}
    noise, poses = np.random.default_rng(0), drive()
    core, online = MixtureLidar(), ScanTrajectory(iterations_per_step=1)
    core.mounting = mounting_of(mounting_message(upside_down))
    assert close(core.mounting.sensor_xyyaw, MOUNTING, 1e-6, 1e-4)
    expected: list[RelativeStep] = []

    def play(step: int, begin_ns: int) -> None:
        stamp_ns, true = begin_ns + step * STEP_NS, poses[min(step, FRAMES - 1)]
        message, wheel = scan_message(true, stamp_ns, upside_down, noise), wheel_pose(true, poses[0])
        if robot_odometry == "topic":
            odometry = Odometry()
            odometry.header.stamp = to_time(stamp_ns)
            odometry.pose.pose.position.x, odometry.pose.pose.position.y = wheel[:2].tolist()
            odometry.pose.pose.orientation.z = math.sin(0.5 * wheel[2])
            odometry.pose.pose.orientation.w = math.cos(0.5 * wheel[2])
            wheels.publish(odometry)
            reading = Imu(header=odometry.header)
            reading.angular_velocity.z = 0.3 if 30 < step < FRAMES else 0.0
            imu.publish(reading)
        if robot_odometry == "tf":
            tf.publish(transform_message(stamp_ns, odom_frame, "base_footprint", wheel))
        if robot_odometry != "none":
            core.add_wheels(stamp_ns, wheel)
        scans.publish(message)
        core.add_scan(scan_of(message, "scan"))
        expected.extend(core.ready())

    def assert_expected(received: list[RelativePose]) -> None:
        for step, message in zip(expected, received, strict=True):
            assert to_ns(message.header.stamp) == step.stamp_ns
            if robot_odometry == "none":  # wheels and scans may arrive in another order
                motion = [message.x, message.y, message.yaw]
                np.testing.assert_allclose(motion, step.relative_xyyaw, rtol=0.0, atol=1e-6)

    with (
        NodeProcess("ngo_estimator", "local_node", settings) as local,
        NodeProcess("ngo_estimator", "ngo_node", ngo_settings) as ngo,
    ):
        local.wait_for_log("ready: /local_node, scan, LaserScan on '/scan'")
        ngo.wait_for_log("ready: /ngo_node, scan")
        probe.spin_until(
            lambda: (
                scans.get_subscription_count() == 1
                and static.get_subscription_count() == 1
                and (robot_odometry != "topic" or wheels.get_subscription_count() == imu.get_subscription_count() == 1)
                and (robot_odometry != "tf" or tf.get_subscription_count() == 2)
            ),
            "the estimators",
        )
        probe.meet("local_node", "ngo_node")
        for step in range(UNMOUNTED + 1):
            play(step, WARM_UP_NS)
        static.publish(mounting_message(upside_down))
        step = UNMOUNTED

        def both_answer() -> bool:
            """Whether ngo_node has heard of the newest scan: before, local_node may not know that it listens."""
            nonlocal step
            if len(out.relative_poses) == step and not out.poses:
                step += 1
                play(step, WARM_UP_NS)
            newest_ns = WARM_UP_NS + step * STEP_NS
            return bool(out.poses) and to_ns(out.poses[-1].header.stamp) == newest_ns

        probe.spin_until(both_answer, "a pose for the newest scan")
        probe.spin_until(lambda: len(out.relative_poses) == step, "the motion to it")
        assert_expected(out.relative_poses)
        for name in ("local_node", "ngo_node"):
            assert probe.call(Reset, f"{name}/reset", Reset.Request()).success
        core.reset()
        expected.clear()
        for step in range(FRAMES):
            play(step, BEGIN_NS)
            # Scans that run ahead of the robot's odometry would not wait for it.
            probe.spin_until(
                lambda: len(out.since(BEGIN_NS).relative_poses) == step,  # noqa: B023
                f"the motion to scan {step}",
            )

        def all_came() -> bool:
            came = out.since(BEGIN_NS)
            odometry = len(came.odometry) == FRAMES - 1 or robot_odometry == "tf"
            transforms = len(came.transforms) >= 2 * FRAMES - 1 or robot_odometry != "tf"
            return len(came.poses) == FRAMES - 1 and odometry and transforms

        probe.spin_until(all_came, "every message about every scan")
        assert "dropped" not in local.log + ngo.log, local.log + ngo.log
        if robot_odometry == "topic":  # and it is heard
            local.wait_for_log("the IMU is not used")
    out = out.since(BEGIN_NS)
    assert len(out.relative_poses) == FRAMES - 1
    assert_expected(out.relative_poses)
    for each in expected:
        update = online.update(each)
    last, moved = out.poses[-1], between(poses[0], poses[-1])
    assert close(xyyaw(last.pose.pose), moved, 0.03, 0.6)
    if robot_odometry == "none":
        np.testing.assert_allclose(xyyaw(last.pose.pose), update.pose_xyyaw, rtol=0.0, atol=1e-5)
    standing = [message for k, message in enumerate(out.relative_poses) if 21 <= k < 29]
    assert not any(message.key_scan for message in standing), "a robot that stands adds no key scans"
    if robot_odometry != "tf":
        return
    assert not out.odometry, "the robot's own odometry is the one of odom"
    transforms = [t for message in out.transforms for t in message.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in transforms} == {
        ("wheels", "base_footprint"),
        ("world", "wheels"),
    }
    assert sum(t.header.frame_id == "wheels" for t in transforms) == FRAMES, "those of the robot, and no other"
    corrections = [t for t in transforms if t.header.frame_id == "world"]
    ahead_ns = round(1e9 * AHEAD_S)
    assert {to_ns(t.header.stamp) - ahead_ns for t in corrections} == {to_ns(each.header.stamp) for each in out.poses}
    assert last.header.frame_id == "world"
    map_from_base = compose(xyyaw(corrections[-1].transform), wheel_pose(poses[-1], poses[0]))
    assert close(map_from_base, xyyaw(last.pose.pose), 0.01, 0.2)


def test_a_scanner_without_a_mounting_is_told_and_one_that_comes_late_counts(probe: Probe) -> None:
    static = probe.node.create_publisher(TFMessage, "/tf_static", LATCHED)
    relative_poses = probe.collect(RelativePose, "relative_pose")
    scans = probe.node.create_publisher(LaserScan, "scan", 1000)
    noise = np.random.default_rng(0)
    with NodeProcess("ngo_estimator", "local_node", RELIABLE) as local:
        local.wait_for_log("ready: /local_node, scan")
        probe.spin_until(lambda: scans.get_subscription_count() == 1, "the estimator")
        probe.meet("local_node")
        for step in range(30):
            scans.publish(scan_message(drive()[step], BEGIN_NS + step * STEP_NS, False, noise))
        local.wait_for_log("/tf_static does not say where 'laser' sits on 'base_link'")
        probe.spin_until(lambda: len(relative_poses) == 29, "a motion for every scan")
        static.publish(mounting_message(False))
        local.wait_for_log(
            "scanner: laser in base_link at x 0.120 m, y -0.050 m, yaw 30.0 deg(.|\n)*starts anew with it"
        )
        for step in range(30, 32):
            scans.publish(scan_message(drive()[step], BEGIN_NS + step * STEP_NS, False, noise))
        probe.spin_until(lambda: len(relative_poses) == 30, "a motion from the first scan with the mounting")
    assert to_ns(relative_poses[-1].origin_stamp) == BEGIN_NS + 30 * STEP_NS


def test_odometry_that_is_published_best_effort_is_heard(probe: Probe) -> None:
    """As robots publish it that take it for a sensor."""
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    wheels = probe.node.create_publisher(Odometry, "wheels", best_effort)
    diagnostics, odometry = Diagnostics(probe), Odometry()
    odometry.pose.pose.orientation.w = 1.0
    settings = {"world": "scan", "robot_odometry": "topic", "robot_odometry_topic": "wheels"}
    with NodeProcess("ngo_estimator", "local_node", settings) as local:
        local.wait_for_log("ready: /local_node, scan")
        probe.meet("local_node")
        for step in range(10):
            odometry.header.stamp = to_time(BEGIN_NS + step * STEP_NS)
            wheels.publish(odometry)
        diagnostics.wait_for_value("/local_node", "robot odometry", lambda value: value == "heard")
