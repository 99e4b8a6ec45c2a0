"""Between ROS messages and arrays: what goes in comes out, over the wire, and what cannot be used is named."""

from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped, Vector3
from nav_msgs.msg import Odometry
from ngo_msgs.msg import RelativePose, Trajectory
from rclpy.serialization import deserialize_message, serialize_message

from ngo_estimator.frontend.camera.local_odometry import LocalEstimate
from ngo_estimator.nodes import messages
from ngo_estimator.slam.trajectory_update import Trajectory as WholeTrajectory


def over_the_wire(message: Any) -> Any:
    return deserialize_message(serialize_message(message), type(message))


def update(loops: int) -> WholeTrajectory:
    """A trajectory of five frames with so many loops."""
    rng = np.random.default_rng(1)
    return WholeTrajectory(
        stamps_ns=np.arange(1, 6) * 1_500_000_001,
        poses_xyyaw=rng.normal(size=(5, 3)),
        odometry_xyyaw=rng.normal(size=(5, 3)),
        online_xyyaw=rng.normal(size=(5, 3)),
        moved_m=rng.random(5),
        loops=np.array([[0, 4], [1, 3]])[:loops],
        odometry_std=rng.random((4, 3)),
        loop_weights=np.array([0.25, 1.0])[:loops],
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
    expected = update(loops=0)
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
