"""ROS messages of what a CARMEN log says, of the classes that rosbags makes for ROS 2 Jazzy."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from ngo_recordings.carmen_lines import NO_RETURN_M, ScanLine

LASER_FRAME = "laser"


@cache
def _message_types() -> dict[str, Any]:
    """The classes that rosbags makes for ROS 2 Jazzy, as other recordings give them."""
    return dict(get_typestore(Stores.ROS2_JAZZY).types)


def _make(type_name: str, *fields: Any) -> Any:
    return _message_types()[type_name](*fields)


def _header(stamp_ns: int, frame: str) -> Any:
    stamp = _make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
    return _make("std_msgs/msg/Header", stamp, frame)


def _rotation(yaw: float) -> Any:
    return _make("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))


def _pose(pose_xyyaw: list[float]) -> Any:
    x, y, yaw = pose_xyyaw
    return _make("geometry_msgs/msg/Pose", _make("geometry_msgs/msg/Point", x, y, 0.0), _rotation(yaw))


def pose_stamped(stamp_ns: int, pose_xyyaw: list[float]) -> Any:
    """A geometry_msgs/PoseStamped in frame map; x, y in m, yaw in rad."""
    return _make("geometry_msgs/msg/PoseStamped", _header(stamp_ns, "map"), _pose(pose_xyyaw))


def odometry(stamp_ns: int, pose_xyyaw: list[float], speed: tuple[float, float]) -> Any:
    """A nav_msgs/Odometry of base_link in odom; speed: forward (m/s), counter-clockwise (rad/s), NaN where unknown."""
    linear = _make("geometry_msgs/msg/Vector3", speed[0], 0.0, 0.0)
    angular = _make("geometry_msgs/msg/Vector3", 0.0, 0.0, speed[1])
    return _make(
        "nav_msgs/msg/Odometry",
        _header(stamp_ns, "odom"),
        "base_link",
        _make("geometry_msgs/msg/PoseWithCovariance", _pose(pose_xyyaw), np.zeros(36)),
        _make("geometry_msgs/msg/TwistWithCovariance", _make("geometry_msgs/msg/Twist", linear, angular), np.zeros(36)),
    )


def laser_scan(stamp_ns: int, scan: ScanLine, limit_m: float | None) -> Any:
    """A sensor_msgs/LaserScan; limit_m: from here on nothing came back, for lines that do not say their range."""
    ranges = scan.ranges.copy()  # the scan may be read again
    if limit_m is not None and scan.range_max is None:
        ranges[~(ranges < limit_m)] = np.inf
    high = scan.range_max if scan.range_max is not None else (limit_m or NO_RETURN_M)
    angle_max = scan.angle_min + (len(ranges) - 1) * scan.angle_increment
    numbers = (scan.angle_min, angle_max, scan.angle_increment, 0.0, 0.0, 0.0, high)
    return _make("sensor_msgs/msg/LaserScan", _header(stamp_ns, LASER_FRAME), *numbers, ranges, np.zeros(0, np.float32))


def static_transform(stamp_ns: int, mounting_xyyaw: np.ndarray) -> Any:
    """A tf2_msgs/TFMessage with the laser in base_link; mounting_xyyaw ``(3,)``: m, m, rad."""
    x, y, yaw = mounting_xyyaw.tolist()
    moved = _make("geometry_msgs/msg/Transform", _make("geometry_msgs/msg/Vector3", x, y, 0.0), _rotation(yaw))
    header = _header(stamp_ns, "base_link")
    return _make("tf2_msgs/msg/TFMessage", [_make("geometry_msgs/msg/TransformStamped", header, LASER_FRAME, moved)])
