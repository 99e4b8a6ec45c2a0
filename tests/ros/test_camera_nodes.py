"""Both estimators as real processes on a camera's pictures; calibration, mounting and odometry come from topics."""

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from ngo_msgs.msg import RelativePose
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from tf2_msgs.msg import TFMessage

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.camera_model import CameraModel
from ngo_estimator.nodes.messages import to_ns, to_time
from ngo_estimator.slam.picture_trajectory import PictureTrajectory
from tests.unit.ngo_estimator.rendered_room import SIZE_M, by_wheels, camera, drive, picture, rays_of

from .processes import LATCHED, NodeProcess, Probe

pytestmark = pytest.mark.processes

FRAMES, STEP_NS, BEGIN_NS = 16, 100_000_000, 5_000_000_000_000
FRAME = "camera_optical_frame"
SETTINGS = {"world": "camera", "image_reliability": "reliable", "image_depth": 1000, "robot_odometry_topic": "wheels"}


def info_message(model: CameraModel) -> CameraInfo:
    message = CameraInfo(height=model.height, width=model.width, distortion_model=model.distortion)
    message.header.frame_id = FRAME
    message.k, message.d = model.matrix.ravel(), model.coefficients.tolist()
    return message


def mounting_message(model: CameraModel) -> TFMessage:
    each = TransformStamped(child_frame_id=FRAME)
    each.header.frame_id = "base_link"
    x, y, z, w = Rotation.from_matrix(model.base_from_camera[:, :3]).as_quat().tolist()
    at = model.centre.tolist()
    each.transform.translation = Vector3(x=at[0], y=at[1], z=at[2])
    each.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
    return TFMessage(transforms=[each])


def odometry_message(stamp_ns: int, pose: np.ndarray) -> Odometry:
    message = Odometry()
    message.header.stamp = to_time(stamp_ns)
    message.pose.pose.position.x, message.pose.pose.position.y = pose[:2].tolist()
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(0.5 * pose[2]), math.cos(0.5 * pose[2])
    return message


def image_message(stamp_ns: int, pixels: np.ndarray) -> Image:
    height, width = pixels.shape[:2]
    message = Image(height=height, width=width, encoding="mono8", step=width, data=pixels.tobytes())
    message.header.stamp, message.header.frame_id = to_time(stamp_ns), FRAME
    return message


def test_live_nodes_follow_a_camera_as_the_cores_do() -> None:
    model, truth = camera(160), drive(FRAMES)
    rays, wheels = rays_of(model), by_wheels(truth)
    core, online, expected = PictureOdometry(model), PictureTrajectory(iterations_per_step=1), list[RelativeStep]()
    with Probe() as probe:
        steps = probe.collect(RelativePose, "relative_pose")
        poses = probe.collect(PoseWithCovarianceStamped, "ngo/pose")
        clouds = probe.collect(PointCloud2, "points")
        static = probe.node.create_publisher(TFMessage, "/tf_static", LATCHED)
        infos = probe.node.create_publisher(CameraInfo, "camera/camera_info", 1000)
        images = probe.node.create_publisher(Image, "camera/image_raw", 1000)
        odometry = probe.node.create_publisher(Odometry, "wheels", 1000)
        settings = {**SETTINGS, "image_topic": "camera/image_raw"}
        with (
            NodeProcess("ngo_estimator", "local_node", {**settings, "robot_odometry": "topic"}) as local,
            NodeProcess("ngo_estimator", "ngo_node", {"world": "camera"}) as ngo,
        ):
            local.wait_for_log("ready: /local_node, camera, pictures on '/camera/image_raw'")
            ngo.wait_for_log("ready: /ngo_node, camera")
            publishers = (static, infos, images, odometry)
            probe.spin_until(lambda: all(each.get_subscription_count() for each in publishers), "the estimators")
            probe.meet("local_node", "ngo_node")
            static.publish(mounting_message(model))
            infos.publish(info_message(model))
            for k, pose in enumerate(truth):
                stamp_ns, pixels = BEGIN_NS + k * STEP_NS, picture(model, rays, pose)
                odometry.publish(odometry_message(stamp_ns, wheels[k]))
                images.publish(image_message(stamp_ns, pixels))
                core.add_wheels(stamp_ns, wheels[k])
                core.add_picture(stamp_ns, pixels)
                expected += core.ready()
            probe.spin_until(lambda: len(steps) == FRAMES - 1 and poses, "a step for each picture")
            last_ns = BEGIN_NS + (FRAMES - 1) * STEP_NS
            probe.spin_until(lambda: to_ns(poses[-1].header.stamp) == last_ns, "the last pose")
            local.wait_for_log("camera: 160 x 120")
            probe.spin_until(lambda: clouds and to_ns(clouds[-1].header.stamp) == last_ns, "the last points")
    points = np.frombuffer(bytes(clouds[-1].data), "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, core.points, atol=0.05)
    on_wall = np.abs(se2.compose(truth[-1], np.column_stack((points[:, :2], np.zeros(len(points)))))[:, :2])
    walls = np.column_stack((on_wall, SIZE_M[:2] - on_wall, points[:, 2], SIZE_M[2] - points[:, 2]))
    assert len(points) > 20 and np.median(np.abs(walls).min(1)) < 0.1
    for step, message in zip(expected, steps, strict=True):
        assert to_ns(message.header.stamp) == step.stamp_ns
        np.testing.assert_allclose((message.x, message.y, message.yaw), step.relative_xyyaw, atol=1e-3)
        assert len(message.place_code) == len(step.place_code)
        update = online.update(step)
    found = poses[-1].pose.pose
    np.testing.assert_allclose((found.position.x, found.position.y), update.pose_xyyaw[:2], atol=5e-3)
