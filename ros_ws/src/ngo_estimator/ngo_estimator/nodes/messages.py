"""Between ROS messages and the arrays of the cores."""

from array import array
from typing import TYPE_CHECKING

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
)
from nav_msgs.msg import Odometry
from ngo_msgs.msg import KeyScan, RelativePose, Trajectory
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from ngo_common.settings import LARGEST_POSE_M
from ngo_estimator.geometry.planar_covariance import to_planar, to_spatial

if TYPE_CHECKING:  # the cores bring torch, which takes seconds: nodes import them after checking their parameters
    from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
    from ngo_estimator.geometry import key_scan
    from ngo_estimator.slam.trajectory_update import Trajectory as WholeTrajectory

_NS = 1_000_000_000
_LARGEST_UNLIKENESS = 1e6  # of what float32 holds


def to_ns(time: Time) -> int:
    """A stamp in nanoseconds."""
    return int(time.sec) * _NS + int(time.nanosec)


def to_time(stamp_ns: int) -> Time:
    """A stamp from nanoseconds."""
    return Time(sec=stamp_ns // _NS, nanosec=stamp_ns % _NS)


def stamped_twist(message: Twist | TwistStamped | Odometry, now_ns: int) -> tuple[int, np.ndarray]:
    """The stamp of a velocity, ``now_ns`` where the message has none, and its ``(3,)`` m/s forward, m/s left, rad/s."""
    stamp_ns = now_ns if isinstance(message, Twist) else to_ns(message.header.stamp)
    twist = message.twist.twist if isinstance(message, Odometry) else getattr(message, "twist", message)
    return stamp_ns, np.array([twist.linear.x, twist.linear.y, twist.angular.z])


def relative_pose_message(estimate: "RelativeStep", base_frame: str) -> RelativePose:
    """One step of the local odometry, stamped with its newer frame."""
    x, y, yaw = estimate.relative_xyyaw.tolist()
    odom_x, odom_y, odom_yaw = estimate.odom_xyyaw.tolist()
    return RelativePose(
        header=Header(stamp=to_time(estimate.stamp_ns), frame_id=base_frame),
        from_stamp=to_time(estimate.from_stamp_ns),
        x=x,
        y=y,
        yaw=yaw,
        covariance=estimate.covariance.ravel(),
        origin_stamp=to_time(estimate.origin_stamp_ns),
        odom_x=odom_x,
        odom_y=odom_y,
        odom_yaw=odom_yaw,
        motion_feature=array("f", estimate.motion_feature.tobytes()),
        place_code=array("f", estimate.place_code.tobytes()),
        unlikeness=min(float(estimate.unlikeness), _LARGEST_UNLIKENESS),
        from_place_code=array("f", b"" if estimate.from_place_code is None else estimate.from_place_code.tobytes()),
        key_scan=[] if estimate.key is None else [_key_scan_message(estimate.key.scan, estimate.key)],
        origin_scan=[] if estimate.origin_scan is None else [_key_scan_message(estimate.origin_scan, None)],
        robot_odom=[] if estimate.robot_odom_xyyaw is None else estimate.robot_odom_xyyaw.tolist(),
        segment=estimate.segment,
    )


def _key_scan_message(scan: "key_scan.KeyScan", step: "KeyScanStep | None") -> KeyScan:
    message = KeyScan(
        stamp=to_time(scan.stamp_ns),
        from_stamp=to_time(scan.stamp_ns if step is None else step.from_key_stamp_ns),
        points=_singles(scan.points),
        normals=_singles(scan.normals),
        angles=_singles(scan.angles),
        ranges=_singles(scan.ranges),
        max_range=scan.max_range,
        sensor=scan.sensor_xyyaw,
    )
    if step is not None:
        message.x, message.y, message.yaw = step.relative_xyyaw.tolist()
        message.covariance = step.covariance.ravel()
        message.factors = step.factors
    return message


def _key_scan(message: KeyScan) -> "key_scan.KeyScan":
    from ngo_estimator.geometry.key_scan import KeyScan as Scan

    points, normals, angles, ranges = (
        np.array(values, np.float64) for values in (message.points, message.normals, message.angles, message.ranges)
    )
    if len(points) % 2 or len(normals) != len(points):
        raise ValueError(f"key scan has {len(points)} and {len(normals)} coordinates; expected as many, in pairs")
    sensor = np.array(message.sensor)
    pairs = points.reshape(-1, 2), normals.reshape(-1, 2)
    return Scan(to_ns(message.stamp), *pairs, sensor, angles, ranges, float(message.max_range))


def _key_scan_step(message: KeyScan) -> "KeyScanStep":
    from ngo_estimator.data.relative_step import KeyScanStep

    relative, covariance = np.array([message.x, message.y, message.yaw]), np.array(message.covariance).reshape(3, 3)
    return KeyScanStep(_key_scan(message), to_ns(message.from_stamp), relative, covariance, np.array(message.factors))


def relative_step(message: RelativePose) -> "RelativeStep":
    """What ``OnlineTrajectory`` takes, from a message; raises ``ValueError`` for a key scan that is none."""
    from ngo_estimator.data.relative_step import RelativeStep

    return RelativeStep(
        stamp_ns=to_ns(message.header.stamp),
        from_stamp_ns=to_ns(message.from_stamp),
        relative_xyyaw=np.array([message.x, message.y, message.yaw]),
        covariance=np.array(message.covariance).reshape(3, 3),
        origin_stamp_ns=to_ns(message.origin_stamp),
        odom_xyyaw=np.array([message.odom_x, message.odom_y, message.odom_yaw]),
        motion_feature=np.array(message.motion_feature, np.float32),
        place_code=np.array(message.place_code, np.float32),
        unlikeness=float(message.unlikeness),
        from_place_code=np.array(message.from_place_code, np.float32) if message.from_place_code else None,
        key=_key_scan_step(message.key_scan[0]) if message.key_scan else None,
        origin_scan=_key_scan(message.origin_scan[0]) if message.origin_scan else None,
        robot_odom_xyyaw=np.array(message.robot_odom) if len(message.robot_odom) else None,
        segment=message.segment,
    )


def odometry_message(estimate: "RelativeStep", covariance: np.ndarray, odom_frame: str, base_frame: str) -> Odometry:
    """The pose in ``odom_frame`` with its covariance ``(3, 3)``, and the mean velocity of the last step."""
    message = Odometry(header=Header(stamp=to_time(estimate.stamp_ns), frame_id=odom_frame), child_frame_id=base_frame)
    message.pose.pose = planar_pose(estimate.odom_xyyaw)
    message.pose.covariance = to_spatial(covariance)
    seconds = (estimate.stamp_ns - estimate.from_stamp_ns) / _NS
    x, y, yaw = (estimate.relative_xyyaw / seconds).tolist()
    message.twist.twist = Twist(linear=Vector3(x=x, y=y), angular=Vector3(z=yaw))
    message.twist.covariance = to_spatial(estimate.covariance / seconds**2)
    return message


def points_message(stamp_ns: int, points: np.ndarray, frame: str) -> PointCloud2:
    """A cloud of points ``(n, 3)``, m."""
    message = PointCloud2(height=1, width=len(points), point_step=12, row_step=12 * len(points), is_dense=True)
    message.header = Header(stamp=to_time(stamp_ns), frame_id=frame)
    message.fields = [
        PointField(name=name, offset=4 * axis, datatype=PointField.FLOAT32, count=1) for axis, name in enumerate("xyz")
    ]
    message.data = array("B", points.astype("<f4").tobytes())
    return message


def pose_message(
    stamp_ns: int, frame: str, pose_xyyaw: np.ndarray, covariance: np.ndarray
) -> PoseWithCovarianceStamped:
    """A pose ``(3,)`` in ``frame`` with its covariance ``(3, 3)``."""
    message = PoseWithCovarianceStamped(header=Header(stamp=to_time(stamp_ns), frame_id=frame))
    message.pose.pose = planar_pose(pose_xyyaw)
    message.pose.covariance = to_spatial(covariance)
    return message


def planar_estimate(message: PoseWithCovarianceStamped, frame: str) -> tuple[np.ndarray, np.ndarray]:
    """The pose ``(3,)`` and its covariance ``(3, 3)`` of a message.

    Raises ``ValueError`` unless it is given in ``frame`` (or in none), is finite and at most ``LARGEST_POSE_M`` away,
    has an orientation, and a covariance that is one.
    """
    if message.header.frame_id not in ("", frame):
        raise ValueError(f"pose is in the frame '{message.header.frame_id}'; expected '{frame}'")
    position, q = message.pose.pose.position, message.pose.pose.orientation
    covariance = to_planar(np.array(message.pose.covariance))
    if not np.isfinite([position.x, position.y, q.x, q.y, q.z, q.w, *covariance.ravel()]).all():
        raise ValueError("pose has values that are not finite")
    if (away := max(abs(position.x), abs(position.y), np.abs(covariance).max() ** 0.5)) > LARGEST_POSE_M:
        raise ValueError(f"pose has a position or a deviation of {away:g} m; expected at most {LARGEST_POSE_M:g}")
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w  # a power would raise an error of its own when it overflows
    if not 0.5 < norm < 2.0:
        raise ValueError(f"pose has an orientation of length {norm**0.5:g}; expected 1")
    if np.abs(covariance - covariance.T).max() > 1e-6 or np.linalg.eigvalsh(covariance)[0] < -1e-9:
        raise ValueError("pose has a covariance of x, y and yaw that is not symmetric and positive")
    yaw = np.arctan2(2.0 * (q.w * q.z + q.x * q.y), norm - 2.0 * (q.y * q.y + q.z * q.z))
    return np.array([position.x, position.y, yaw]), covariance


def transform_message(stamp_ns: int, parent: str, child: str, parent_from_child: np.ndarray) -> TFMessage:
    """One transform ``(3,)`` for /tf."""
    pose = planar_pose(parent_from_child)
    transform = Transform(translation=Vector3(x=pose.position.x, y=pose.position.y), rotation=pose.orientation)
    header = Header(stamp=to_time(stamp_ns), frame_id=parent)
    return TFMessage(transforms=[TransformStamped(header=header, child_frame_id=child, transform=transform)])


def planar_pose(pose_xyyaw: np.ndarray) -> Pose:
    """A pose ``(3,)`` as position and quaternion."""
    x, y, yaw = pose_xyyaw.tolist()
    return Pose(
        position=Point(x=x, y=y),
        orientation=Quaternion(z=float(np.sin(0.5 * yaw)), w=float(np.cos(0.5 * yaw))),
    )


def trajectory_message(trajectory: "WholeTrajectory", frame: str) -> Trajectory:
    """The whole trajectory in flat arrays, poses in ``frame``."""
    return Trajectory(
        header=Header(stamp=to_time(int(trajectory.stamps_ns[-1])), frame_id=frame),
        stamps_ns=array("q", trajectory.stamps_ns.astype(np.int64).tobytes()),
        x=_doubles(trajectory.poses_xyyaw[:, 0]),
        y=_doubles(trajectory.poses_xyyaw[:, 1]),
        yaw=_doubles(trajectory.poses_xyyaw[:, 2]),
        moved=_doubles(trajectory.moved_m),
    )


def _singles(values: np.ndarray) -> "array[float]":
    return array("f", values.astype(np.float32).tobytes())


def _doubles(values: np.ndarray) -> "array[float]":
    return array("d", values.astype(np.float64).tobytes())
