"""Messages say what the cores say, and are written as fast as arrays."""

from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped, Vector3
from nav_msgs.msg import Odometry, Path
from ngo_msgs.msg import KeyScan, RelativePose, Trajectory
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from visualization_msgs.msg import Marker, MarkerArray

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.local_odometry import LocalEstimate
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.loop_message import LoopMarkerWriter, loop_colors, plain_loops
from ngo_estimator.nodes.messages import relative_pose_message, relative_step
from ngo_estimator.nodes.path_message import PathWriter, plain_path
from ngo_estimator.nodes.step_messages import ODOMETRY, POSE, TF, TYPES, StepMessages
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory as WholeTrajectory
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate
from tests.unit.ngo_estimator.lidar_steps import lidar_steps
from tests.unit.ngo_estimator.ray_casting import ROOM, scan_at


def over_the_wire(message: Any) -> Any:
    return deserialize_message(serialize_message(message), type(message))


def with_loops(loops: int, frames: int = 500) -> WholeTrajectory:
    """A trajectory with so many loops, some of them with weights beyond 0 and 1."""
    rng = np.random.default_rng(loops)
    return WholeTrajectory(
        stamps_ns=np.arange(1, frames + 1) * 1_500_000_001,
        poses_xyyaw=rng.normal(0.0, 10.0, (frames, 3)),
        odometry_xyyaw=rng.normal(size=(frames, 3)),
        online_xyyaw=rng.normal(size=(frames, 3)),
        moved_m=rng.random(frames),
        loops=rng.integers(0, frames, (loops, 2)),
        odometry_std=rng.random((frames - 1, 3)),
        loop_weights=rng.uniform(-0.5, 1.5, loops),
        loop_relative_xyyaw=rng.normal(size=(loops, 3)),
        loop_std=rng.random((loops, 3)),
    )


def twist_messages() -> list[Any]:
    """One motion in each type that has it, stamped at 7.5 s where there is a stamp."""
    twist = Twist(linear=Vector3(x=0.5, y=-0.25, z=9.0), angular=Vector3(x=9.0, y=9.0, z=0.125))
    stamped, odometry = TwistStamped(twist=twist), Odometry()
    odometry.twist.twist = twist
    for message in (stamped, odometry):
        message.header.stamp = messages.to_time(7_500_000_000)
    return [twist, stamped, odometry]


@pytest.mark.parametrize("message", twist_messages(), ids=lambda message: type(message).__name__)
def test_a_velocity_is_planar_and_has_the_stamp_of_its_message_or_of_now(message: Any) -> None:
    stamp_ns, twist_xyyaw = messages.stamped_twist(over_the_wire(message), now_ns=3)
    assert stamp_ns == (3 if isinstance(message, Twist) else 7_500_000_000)
    assert twist_xyyaw.tolist() == [0.5, -0.25, 0.125]


def test_a_relative_pose_keeps_every_number() -> None:
    rng = np.random.default_rng(2)
    estimate = LocalEstimate(
        stamp_ns=1_700_000_000_057_142_857,
        from_stamp_ns=1_700_000_000_000_000_000,
        origin_stamp_ns=1_699_999_999_999_999_999,
        relative_xyyaw=rng.normal(size=3),
        covariance=rng.normal(size=(3, 3)),
        odom_xyyaw=rng.normal(size=3),
        motion_feature=rng.normal(size=64).astype(np.float32),
        place_code=rng.normal(size=128).astype(np.float32),
        missed_frames=0,
    )
    message: RelativePose = over_the_wire(messages.relative_pose_message(estimate, "base"))
    assert message.header.frame_id == "base"
    step = messages.relative_step(message)
    for name, value in vars(step).items():
        np.testing.assert_array_equal(value, getattr(estimate, name), err_msg=name)


def test_odometry_has_the_pose_and_the_mean_velocity() -> None:
    estimate = LocalEstimate(
        stamp_ns=2_250_000_000,
        from_stamp_ns=2_000_000_000,
        origin_stamp_ns=0,
        relative_xyyaw=np.array([0.5, -0.1, 0.2]),
        covariance=np.diag([0.01, 0.02, 0.03]),
        odom_xyyaw=np.array([1.0, 2.0, np.pi]),
        motion_feature=np.zeros(0, np.float32),
        place_code=np.zeros(0, np.float32),
        missed_frames=0,
    )
    message: Odometry = over_the_wire(messages.odometry_message(estimate, np.diag([1.0, 2.0, 3.0]), "odom", "base"))
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base")
    assert messages.to_ns(message.header.stamp) == 2_250_000_000
    pose, twist = message.pose.pose, message.twist.twist
    assert (pose.position.x, pose.position.y, pose.orientation.z) == (1.0, 2.0, 1.0)
    assert pose.orientation.w == pytest.approx(0.0, abs=1e-15)
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == (2.0, -0.4, 0.8)
    assert [message.pose.covariance[index] for index in (0, 7, 35)] == [1.0, 2.0, 3.0]
    assert [message.twist.covariance[index] for index in (0, 7, 35)] == pytest.approx([0.16, 0.32, 0.48])


def test_a_trajectory_keeps_every_number() -> None:
    expected = with_loops(0)
    message: Trajectory = over_the_wire(messages.trajectory_message(expected, "map"))
    assert messages.to_ns(message.header.stamp) == expected.stamps_ns[-1]
    np.testing.assert_array_equal(message.stamps_ns, expected.stamps_ns)
    np.testing.assert_array_equal(np.column_stack((message.x, message.y, message.yaw)), expected.poses_xyyaw)
    np.testing.assert_array_equal(message.moved, expected.moved_m)


def given_pose(**changes: Any) -> PoseWithCovarianceStamped:
    """A pose as of RViz, with some fields of it changed."""
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    message.pose.pose = messages.planar_pose(np.array([1.0, -2.0, 3.0]))
    message.pose.covariance[0], message.pose.covariance[7], message.pose.covariance[35] = 0.25, 0.5, 0.07
    for path, value in changes.items():
        *holders, name = path.split("__")
        holder: Any = message
        for each in holders:
            holder = getattr(holder, each)
        setattr(holder, name, value)
    return message


def test_an_initial_pose_is_read() -> None:
    pose, covariance = messages.planar_estimate(over_the_wire(given_pose()), "map")
    np.testing.assert_allclose(pose, [1.0, -2.0, 3.0])
    np.testing.assert_array_equal(covariance, np.diag([0.25, 0.5, 0.07]))
    messages.planar_estimate(given_pose(header__frame_id=""), "map")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"header__frame_id": "odom"}, "is in the frame 'odom'; expected 'map'"),
        ({"pose__pose__position__x": float("nan")}, "has values that are not finite"),
        ({"pose__covariance": [float("inf")] * 36}, "has values that are not finite"),
        ({"pose__pose__position__y": 1e308}, "has a position or a deviation of 1e.308 m; expected at most 1e.09"),
        ({"pose__covariance": [1e308] + [0.0] * 35}, "has a position or a deviation of 1e.154 m"),
        ({"pose__pose__orientation__w": 1e308}, "has an orientation of length inf"),
        ({"pose__pose__orientation__w": 0.0, "pose__pose__orientation__z": 0.0}, "has an orientation of length 0"),
        ({"pose__covariance": [-1.0] + [0.0] * 35}, "has a covariance"),
        ({"pose__covariance": [1.0, 1.0] + [0.0] * 34}, "has a covariance"),
    ],
)
def test_what_is_wrong_with_an_initial_pose_is_named(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=f"^pose {reason}") as error:
        messages.planar_estimate(given_pose(**changes), "map")
    assert "\n" not in str(error.value)


def trajectory(frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Stamps over several seconds and days, and poses, of `frames` frames."""
    stamps_ns = np.cumsum(rng.integers(1, 10**14, frames)).astype(np.int64)
    return stamps_ns, rng.normal(0.0, 10.0, (frames, 3))


@pytest.mark.parametrize("frame_id", ["map", "m", "mapp", "a_long_frame/of_many_parts", "käfig"])
def test_equals_the_plain_message_for_every_length_in_any_order(frame_id: str) -> None:
    rng = np.random.default_rng(0)
    writer = PathWriter(frame_id)
    for frames in [*range(51), 2000, 2, 50, 0, 1, 777]:
        stamps_ns, poses_xyyaw = trajectory(frames, rng)
        read = deserialize_message(writer.write(10**18 + 5, stamps_ns, poses_xyyaw), Path)
        assert read == plain_path(frame_id, 10**18 + 5, stamps_ns, poses_xyyaw), frames


def test_two_messages_share_no_memory() -> None:
    rng = np.random.default_rng(1)
    writer = PathWriter("map")
    stamps_ns, poses_xyyaw = trajectory(5, rng)
    first = writer.write(1, stamps_ns, poses_xyyaw)
    writer.write(2, stamps_ns + 7, poses_xyyaw + 1.0)
    assert deserialize_message(first, Path) == plain_path("map", 1, stamps_ns, poses_xyyaw)


@pytest.mark.parametrize("frame_id", ["map", "m", "mapp", "a_long_frame/of_many_parts", "käfig"])
def test_equals_the_plain_message_for_any_number_of_loops(frame_id: str) -> None:
    writer = LoopMarkerWriter(frame_id)
    for loops in (3, 1, 512, 0, 2):
        given = with_loops(loops)
        read = deserialize_message(writer.write(given), MarkerArray)
        ends, stamp_ns = given.poses_xyyaw[given.loops.reshape(-1), :2], int(given.stamps_ns[-1])
        plain = plain_loops(frame_id, stamp_ns, ends, np.repeat(loop_colors(given.loop_weights), 2, axis=0))
        assert read == deserialize_message(serialize_message(plain), MarkerArray), loops
        (marker,) = read.markers
        assert marker.action == (Marker.ADD if loops else Marker.DELETE)
        assert (marker.type, marker.header.frame_id) == (Marker.LINE_LIST, frame_id)
        assert [(point.x, point.y) for point in marker.points] == [tuple(end) for end in ends.tolist()]


def test_what_is_thought_of_a_loop_shows_in_its_color() -> None:
    believed, faint, doubted, refused = loop_colors(np.array((1.0, 0.6, 0.3, 0.0)))
    assert believed[2] == faint[2] == max(believed[:3]) and (believed[3], faint[3]) == (1.0, 0.6)  # blue
    assert doubted[0] == max(doubted[:3]) and doubted[1] > 0.5 > refused[1]  # orange and red
    assert refused[0] == max(refused[:3]) and doubted[3] == refused[3] > 0.0


@pytest.mark.parametrize("frames", [("base_link", "odom", "map"), ("b", "my_robot/odom", "käfig")])
def test_equal_the_plain_messages_for_each_step(frames: tuple[str, str, str]) -> None:
    base, odom, map_frame = frames
    store, rng, nothing = get_typestore(Stores.ROS2_JAZZY), np.random.default_rng(20000), np.zeros(0, np.float32)

    def serialised(message: object, type_name: str) -> bytes:
        return bytes(store.serialize_cdr(message, type_name))

    writer = StepMessages(*frames, serialised)
    for number in range(20):
        begin_ns, end_ns = np.sort(rng.integers(1, 2 * 10**18, 2)).tolist()
        root, poses = rng.normal(size=(3, 3, 3)), rng.normal(0.0, 10.0, (5, 3))
        odometry, step_covariance, covariance = root @ root.mT
        robot = poses[4] if number % 2 else None
        step = RelativeStep(
            end_ns, begin_ns, poses[0], step_covariance, 0, poses[1], nothing, nothing, robot_odom_xyyaw=robot
        )
        update = TrajectoryUpdate(end_ns, poses[2], covariance, poses[3], 2, False, False, False, 0.0, 0, 0.0, "")
        transforms = messages.transform_message(end_ns, map_frame, odom, update.map_from_odom_xyyaw)
        transforms.transforms += messages.transform_message(end_ns, odom, base, step.tf_odom_xyyaw).transforms
        plain = {
            ODOMETRY: messages.odometry_message(step, odometry, odom, base),
            POSE: messages.pose_message(end_ns, map_frame, update.pose_xyyaw, covariance),
            TF: transforms,
        }
        assert writer.of(step, odometry, update) == {
            topic: serialised(message, TYPES[topic]) for topic, message in plain.items()
        }


POSES = np.column_stack((0.1 * np.arange(8), np.zeros(8), np.zeros(8)))
STEPS = list(lidar_steps(POSES, lambda k, stamp_ns: scan_at(ROOM, POSES[k] + (1.0, 1.0, 0.3), stamp_ns)))
KEY = next(k for k, step in enumerate(STEPS) if step.key is not None)


def message(**changes: Any) -> RelativePose:
    made: RelativePose = relative_pose_message(STEPS[KEY], "base_link")
    for name, value in changes.items():
        setattr(made.key_scan[0], name, value)
    return made


def test_a_key_scan_comes_as_it_was_sent() -> None:
    sent, step = STEPS[KEY].key, relative_step(message())
    assert sent is not None and step.key is not None
    for part in ("points", "normals", "angles", "ranges", "sensor_xyyaw"):
        np.testing.assert_array_equal(getattr(step.key.scan, part), getattr(sent.scan, part))
    assert step.key.scan.stamp_ns == sent.scan.stamp_ns and step.key.from_key_stamp_ns == sent.from_key_stamp_ns
    np.testing.assert_array_equal(step.key.covariance, sent.covariance)


@pytest.mark.parametrize(
    "changes",
    [
        {"points": [1.0, 2.0, 3.0]},
        {"points": []},
        {"normals": [1.0] * 4},
        {"points": [float("nan")] * 4, "normals": [0.0] * 4},
        {"points": [1e30] * 4, "normals": [0.0] * 4},
        {"points": [1.0] * 200_000, "normals": [0.0] * 200_000},
        {"angles": [0.0] * 500_000, "ranges": [1.0] * 500_000},
        {"angles": [0.0]},
        {"angles": [float("inf")], "ranges": [1.0]},
        {"max_range": 0.0},
        {"max_range": float("inf")},
        {"sensor": [float("nan"), 0.0, 0.0]},
        {"covariance": [float("nan")] * 9},
        {"covariance": [0.0] * 9},
        {"x": float("nan")},
        {"stamp": KeyScan().stamp},
    ],
    ids=lambda changes: str(changes)[:50],
)
def test_a_bad_key_scan_is_refused_in_one_line(changes: dict[str, Any]) -> None:
    trajectory = ScanTrajectory()
    for step in STEPS[:KEY]:
        trajectory.update(step)
    before = trajectory.trajectory()
    with pytest.raises(ValueError, match=r"expected|finite") as told:
        trajectory.update(relative_step(message(**changes)))
    after = trajectory.trajectory()
    assert "\n" not in str(told.value) and len(str(told.value)) < 400
    assert before is not None and after is not None and before.poses_xyyaw.tobytes() == after.poses_xyyaw.tobytes()
    assert not trajectory.update(relative_step(message())).gap


@pytest.mark.parametrize("values", [[1.0], [1.0, 2.0, 3.0, 4.0], [0.0, float("nan"), 0.0]])
def test_a_bad_pose_of_the_robots_odometry_is_refused(values: list[float]) -> None:
    made = message()
    made.robot_odom = values
    with pytest.raises(ValueError, match="robot_odom_xyyaw"):
        ScanTrajectory().update(relative_step(made))
