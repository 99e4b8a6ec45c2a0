"""Loops as the bytes of a visualization_msgs/MarkerArray: numpy writes what would be a thousand small messages."""

from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import Point
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ngo_estimator.graph.relative_poses import BELIEVED
from ngo_estimator.nodes.messages import to_time
from ngo_estimator.slam.loop_report import REFUSED_BELOW

if TYPE_CHECKING:  # brings torch, which takes seconds: nodes import it after checking their parameters
    from ngo_estimator.slam.trajectory_update import Trajectory

_WIDTH_M = 0.03
_COLORS = np.array(((0.1, 0.5, 0.9), (0.95, 0.6, 0.1), (0.85, 0.1, 0.15)))
"""Of loops that are believed, doubted and refused."""

_FAINTEST = 0.3  # Opacity of a loop that is not believed: what is refused is to be seen.

_STAMP = np.dtype([("sec", np.int32), ("nanosec", np.uint32)])
_STAMP_AT = 8  # Behind the encapsulation and the number of markers, 4 bytes each.


class LoopMarkerWriter:
    """Writes one line for each loop, in the color of what is thought of it; without loops, a marker that deletes them.

    A template is serialised once. In CDR the points lie in one piece, and behind them the colors; their numbers stand
    right before both, since the doubles before them end on eight bytes.
    """

    def __init__(self, frame_id: str) -> None:
        """Lay out messages in ``frame_id``; raises ``RuntimeError`` for a middleware that serialises differently."""
        self._frame_id = frame_id
        stamp_ns, ends, both = 7_000_000_009, np.array([[-1.5, 2.5], [3.5, -4.5]]), loop_colors(np.array([0.25, 0.75]))
        template = bytes(serialize_message(plain_loops(frame_id, stamp_ns, ends, both)))
        points, colors = _packed(ends, both)
        begins = template.find(points)
        behind = begins + len(points) + 4 + len(colors)
        self._head, self._tail = bytearray(template[: begins - 4]), template[behind:]
        written = self._write(stamp_ns, ends, both)
        if begins < 0 or written != template:
            raise RuntimeError("this middleware's serialised MarkerArray is not laid out as plain CDR")

    def write(self, trajectory: "Trajectory") -> bytes:
        """The message of the loops of one trajectory."""
        ends = trajectory.poses_xyyaw[trajectory.loops.reshape(-1), :2]
        colors = np.repeat(loop_colors(trajectory.loop_weights), 2, axis=0)
        stamp_ns = int(trajectory.stamps_ns[-1])
        if len(ends) == 0:
            return bytes(serialize_message(plain_loops(self._frame_id, stamp_ns, ends, colors)))
        return self._write(stamp_ns, ends, colors)

    def _write(self, stamp_ns: int, ends: np.ndarray, colors: np.ndarray) -> bytes:
        np.ndarray((1,), _STAMP, self._head, _STAMP_AT)[0] = divmod(stamp_ns, 1_000_000_000)
        count, (points, packed) = np.uint32(len(ends)).tobytes(), _packed(ends, colors)
        return b"".join((self._head, count, points, count, packed, self._tail))


def loop_colors(weights: np.ndarray) -> np.ndarray:
    """Colors ``(n, 4)`` of loops with these weights ``(n,)``; one that is believed is as opaque as its weight."""
    share = np.clip(weights, 0.0, 1.0)
    doubt = (share <= BELIEVED).astype(np.int64) + (share < REFUSED_BELOW)
    return np.column_stack((_COLORS[doubt], np.where(doubt > 0, _FAINTEST, share)))


def plain_loops(frame_id: str, stamp_ns: int, ends: np.ndarray, colors: np.ndarray) -> MarkerArray:
    """The same message built point by point: the slow definition of what ``LoopMarkerWriter`` writes.

    Args:
        ends: of all lines in m ``(2 * lines, 2)``, those of a line behind each other; colors: of all ends
            ``(2 * lines, 4)``.
    """
    header = Header(stamp=to_time(stamp_ns), frame_id=frame_id)
    marker = Marker(header=header, ns="loops", type=Marker.LINE_LIST, action=Marker.ADD)
    if len(ends) == 0:
        marker.action = Marker.DELETE
        return MarkerArray(markers=[marker])
    marker.pose.orientation.w = 1.0
    marker.scale.x = _WIDTH_M
    marker.points = [Point(x=x, y=y) for x, y in ends.tolist()]
    marker.colors = [ColorRGBA(r=red, g=green, b=blue, a=opacity) for red, green, blue, opacity in colors.tolist()]
    return MarkerArray(markers=[marker])


def _packed(ends: np.ndarray, colors: np.ndarray) -> tuple[bytes, bytes]:
    """Points ``(n, 3)`` and colors ``(n, 4)`` as they lie in the message."""
    points = np.zeros((len(ends), 3))
    points[:, :2] = ends
    return points.tobytes(), colors.astype(np.float32).tobytes()
