"""The local estimator as a real process on each kind of sensor: laser scans of the simulator, compressed pictures."""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from nav_msgs.msg import Odometry
from ngo_msgs.msg import RelativePose
from PIL import Image as Picture
from sensor_msgs.msg import CompressedImage, Image, LaserScan

from ngo_estimator.checkpoint import LOCAL, save_checkpoint, write_untrained
from ngo_estimator.data.images import ImageFormat, scan_image
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.geometry import se2
from ngo_estimator.networks.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from ngo_estimator.nodes.messages import to_ns, to_time
from tests.unit.ngo_estimator.samples import SCAN

from .processes import NodeProcess, Probe
from .readings import xyyaw

pytestmark = pytest.mark.processes

FRAMES = 25
STEP_NS = 100_000_000
CAMERA = ImageFormat(12, 16, 1, "uint8")
RELIABLE = {"image_reliability": "reliable", "image_depth": 1000}
WAITING = {"wait_for_flow_control": True, "wait_for_subscribers": 1}


@pytest.fixture
def probe() -> Iterator[Probe]:
    torch.manual_seed(0)
    with Probe() as probe:
        yield probe


def let_begin(simulator: NodeProcess, probe: Probe) -> None:
    """Subscribe to the image, for which the simulator waits, when it has long known who listens to its scans."""
    simulator.wait_for_log("ready: ")
    probe.meet("maze2d")
    probe.collect(Image, "image")


def assert_same_motion(core: LocalOdometry, message: RelativePose, image: np.ndarray, twist: np.ndarray | None) -> None:
    estimate = core.update(to_ns(message.header.stamp), image, None, twist)
    assert estimate is not None and to_ns(message.from_stamp) == estimate.from_stamp_ns
    received = [message.x, message.y, message.yaw]
    np.testing.assert_allclose(received, estimate.relative_xyyaw, atol=1e-6)


def test_the_simulators_laser_becomes_odometry(probe: Probe, tmp_path: Path) -> None:
    write_untrained(tmp_path, "our_robot", SCAN)
    core = LocalOdometry.load(tmp_path, "our_robot")
    scans, odometry = probe.collect(LaserScan, "scan"), probe.collect(Odometry, "odom")
    relative_poses = probe.collect(RelativePose, "relative_pose")
    settings = {"world": "our_robot", "weights": str(tmp_path), **RELIABLE}
    maze = {"frames": FRAMES, "rate": 0.0, "flow_control_topics": ["odom"], **WAITING}
    with NodeProcess("ngo_estimator", "local_node", settings) as local:
        local.wait_for_log("ready: /local_node, our_robot, LaserScan on '/scan'")
        probe.meet("local_node")
        with NodeProcess("ngo_sim", "maze2d", maze) as simulator:
            let_begin(simulator, probe)
            probe.spin_until(lambda: len(odometry) == len(relative_poses) == FRAMES - 1, "odometry of every scan")
            probe.spin_until(lambda: len(scans) == FRAMES, "every scan")
            assert simulator.wait() == 0, simulator.log
        assert "dropped" not in local.log, local.log
    observed = [
        scan_image(core.image_format, np.array(m.ranges), m.angle_min, m.angle_increment, m.range_min, m.range_max)
        for m in scans
    ]
    assert np.isinf(observed[0]).any() and np.isfinite(observed[0]).mean() == pytest.approx(300 / 360, abs=0.01)
    assert core.update(to_ns(scans[0].header.stamp), observed[0], None) is None
    for message, image in zip(relative_poses, observed[1:], strict=True):
        assert_same_motion(core, message, image, None)
    assert [to_ns(m.header.stamp) for m in odometry] == [to_ns(m.header.stamp) for m in scans[1:]]


def test_compressed_pictures_and_velocities_become_odometry(probe: Probe, tmp_path: Path) -> None:
    write_untrained(tmp_path, "our_robot", CAMERA)
    config = LocalPoseConfig(CAMERA, 0.125, 0, 0.1, relative_std=(0.1, 0.02, 0.05), twist=True)
    save_checkpoint(tmp_path / f"{LOCAL}.safetensors", LocalPoseNetwork(config), LOCAL, "our_robot", {})
    core = LocalOdometry.load(tmp_path, "our_robot")
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (5, *CAMERA.shape), dtype=np.uint8)
    images = probe.node.create_publisher(CompressedImage, "camera/compressed", 100)
    twists = probe.node.create_publisher(TwistStamped, "wheels", 100)
    relative_poses = probe.collect(RelativePose, "relative_pose")
    names = {"image_topic": "camera", "image_transport": "compressed", "twist_topic": "wheels"}
    settings = {"world": "our_robot", "weights": str(tmp_path), **names, **RELIABLE}
    with NodeProcess("ngo_estimator", "local_node", settings) as local:
        local.wait_for_log("ready: /local_node, our_robot, CompressedImage on '/camera/compressed'")
        probe.spin_until(
            lambda: images.get_subscription_count() and twists.get_subscription_count(),
            "the estimator",
        )
        probe.meet("local_node")
        for step, pixels in enumerate(pictures):
            for part, speed in ((0.5, step), (1.0, step + 1.0)):  # two velocities in each step
                message = TwistStamped()
                message.header.stamp = to_time(int((step - 1 + part) * STEP_NS) + 10 * STEP_NS)
                message.twist.linear.x, message.twist.angular.z = float(speed), -0.1
                twists.publish(message)
            buffer = io.BytesIO()
            Picture.fromarray(pixels[..., 0]).save(buffer, "png")
            for data in (bytes(7), buffer.getvalue()):  # the first of the two is no picture
                message = CompressedImage(format="png", data=data)
                message.header.stamp = to_time((step + 10) * STEP_NS)
                images.publish(message)
        probe.spin_until(lambda: len(relative_poses) == len(pictures) - 1, "every motion")
        local.wait_for_log("dropped image: images of camera/compressed have the format 'png'; supported")
    core.update(10 * STEP_NS, pictures[0], None)
    for step, message in enumerate(relative_poses, start=1):
        assert_same_motion(core, message, pictures[step], np.array([step + 0.5, 0.0, -0.1]))


def test_compressed_pictures_for_weights_that_take_depth_end_the_start(probe: Probe, tmp_path: Path) -> None:
    write_untrained(tmp_path, "maze2d")
    settings = {"world": "maze2d", "weights": str(tmp_path), "image_transport": "compressed"}
    with NodeProcess("ngo_estimator", "local_node", settings) as local:
        assert local.wait() == 2, local.log
        local.wait_for_log("parameter 'image_transport': the weights take 4 channels of float32")
        assert len(local.lines) == 1, local.log


def test_the_shipped_lidar_follows_the_simulator(probe: Probe) -> None:
    """Both estimators as a user starts them, on a maze of the validation split."""
    frames = 160
    truth, odometry = probe.collect(Odometry, "ground_truth"), probe.collect(Odometry, "odom")
    poses = probe.collect(PoseWithCovarianceStamped, "ngo/pose")
    maze = {"frames": frames, "rate": 0.0, "seed": 1500, **WAITING}
    with (
        NodeProcess("ngo_estimator", "local_node", {"world": "scan", **RELIABLE}) as local,
        NodeProcess("ngo_estimator", "ngo_node", {"world": "scan"}) as ngo,
    ):
        local.wait_for_log("ready: /local_node, scan")
        ngo.wait_for_log("ready: /ngo_node, scan")
        probe.meet("local_node", "ngo_node")
        with NodeProcess("ngo_sim", "maze2d", maze) as simulator:
            let_begin(simulator, probe)
            probe.spin_until(lambda: len(odometry) == len(poses) == frames - 1, "a pose for every scan")
            probe.spin_until(lambda: len(truth) == frames, "the truth")
            assert simulator.wait() == 0, simulator.log
        assert "dropped" not in local.log + ngo.log, local.log + ngo.log
    driven = np.array([[m.pose.pose.position.x, m.pose.pose.position.y] for m in truth])
    length_m = np.linalg.norm(np.diff(driven, axis=0), axis=1).sum()
    start, end = (xyyaw(message) for message in (truth[0], truth[-1]))
    moved = se2.between(torch.from_numpy(start), torch.from_numpy(end)).numpy()
    assert length_m > 10.0 and np.linalg.norm(moved[:2]) > 1.0
    for estimate in (odometry[-1], poses[-1]):
        error = xyyaw(estimate) - moved
        assert np.linalg.norm(error[:2]) < 0.03 * length_m, error
        assert abs(np.remainder(error[2] + np.pi, 2.0 * np.pi) - np.pi) < np.radians(6.0), error
