"""Frontiers, goal and path as messages."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Path
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ngo_explorer.known_map import Floats

if TYPE_CHECKING:
    from ngo_explorer.exploration import Exploration

_BLUE, _GREEN, _RED = (0.1, 0.3, 1.0), (0.1, 0.8, 0.2), (0.9, 0.1, 0.1)


def pose_message(pose_xyyaw: Floats, frame: str, stamp: Time) -> PoseStamped:
    """A planar pose ``(3,)``."""
    x, y, yaw = pose_xyyaw.tolist()
    placed = Pose(position=Point(x=x, y=y), orientation=Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2)))
    return PoseStamped(header=Header(frame_id=frame, stamp=stamp), pose=placed)


def path_message(path: Floats, frame: str, stamp: Time) -> Path:
    """A path ``(n, 2)``, a point every few cells."""
    header = Header(frame_id=frame, stamp=stamp)
    some = path[:: max(1, len(path) // 200)]
    points = [PoseStamped(header=header, pose=Pose(position=Point(x=float(x), y=float(y)))) for x, y in some]
    return Path(header=header, poses=points)


def frontier_markers(exploration: Exploration, frame: str, stamp: Time) -> MarkerArray:
    """Cells of the frontiers that can be reached (blue, the goal's green), and places of those that cannot (red)."""
    header = Header(frame_id=frame, stamp=stamp)
    size = max(exploration.known.resolution_m, 0.02)
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    chosen = exploration.goal.candidate if exploration.goal is not None else None
    for number, candidate in enumerate(exploration.candidates):
        color = _GREEN if candidate is chosen else _BLUE
        markers.append(_cells(header, number, candidate.frontier.points_xy, size, color))
    if exploration.unreachable:
        points = np.array([left.point_xy for left in exploration.unreachable])
        markers.append(_cells(header, len(markers), points, 3.0 * size, _RED))
    return MarkerArray(markers=markers)


def _cells(header: Header, number: int, points: Floats, size: float, color: tuple[float, float, float]) -> Marker:
    marker = Marker(header=header, ns="frontiers", id=number, type=Marker.POINTS, action=Marker.ADD)
    marker.scale.x = marker.scale.y = size
    marker.pose.orientation.w = 1.0
    red, green, blue = color
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    marker.points = [Point(x=float(x), y=float(y)) for x, y in points]
    return marker
