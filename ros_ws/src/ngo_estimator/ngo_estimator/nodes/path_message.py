"""nav_msgs/Path as bytes, written by numpy: a thousand times cheaper than building a PoseStamped a pose."""

from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

_NS = 1_000_000_000
_TEMPLATE_POSES = 3


class PathWriter:
    """Writes planar trajectories as serialised ``nav_msgs/Path``, ready for ``publisher.publish(bytes)``.

    A template is serialised once. In CDR every pose after the first then takes the same number of bytes,
    because it follows eight-byte doubles and all poses share one ``frame_id``; each starts with its stamp and
    ends with its seven doubles. The first pose may be padded differently, as the message's header comes
    before it, so it belongs to the head of the buffer. The buffer doubles when a trajectory outgrows it,
    which costs O(1) a pose.
    """

    def __init__(self, frame_id: str, serialise: Callable[[Path], bytes] = serialize_message) -> None:
        """Lay out the buffer for poses in ``frame_id``; raises ``RuntimeError`` for any other layout.

        ``serialise`` makes the template, and so the bytes between the values, which the middleware leaves to chance.
        """
        self._frame_id, self._serialise = frame_id, serialise
        template = self._template(_TEMPLATE_POSES)
        self._stride = len(template) - len(self._template(_TEMPLATE_POSES - 1))
        self._head = len(template) - (_TEMPLATE_POSES - 1) * self._stride  # up to the end of the first pose
        # Encapsulation (4 bytes), stamp (8), length of frame_id (4), and its bytes with a final zero.
        self._count = 16 + _aligned(len(frame_id.encode()) + 1, 4)
        self._buffer = bytearray(template)
        self._check_layout()

    def write(self, stamp_ns: int, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> bytes:
        """The message of one trajectory: ``stamps_ns`` ``(frames,)`` int64, ``poses_xyyaw`` ``(frames, 3)``.

        ``stamp_ns`` becomes the stamp of the path itself.
        """
        frames = len(stamps_ns)
        if stamps_ns.shape != (frames,) or poses_xyyaw.shape != (frames, 3):
            raise ValueError(f"stamps are {stamps_ns.shape} and poses {poses_xyyaw.shape}; expected (n,) and (n, 3)")
        if frames == 0:
            return bytes(self._serialise(Path(header=Header(stamp=_time(stamp_ns), frame_id=self._frame_id))))
        size = self._head + (frames - 1) * self._stride
        while len(self._buffer) < size:
            self._buffer += self._buffer[self._head :]
        self._stamps(4, 1)[0] = divmod(stamp_ns, _NS)
        np.ndarray((1,), np.uint32, self._buffer, self._count)[0] = frames
        first, rest = self._stamps(self._count + 4, 1), self._stamps(self._head, frames - 1)
        seconds, nanoseconds = np.divmod(stamps_ns, _NS)
        for stamps, part in ((first, slice(0, 1)), (rest, slice(1, None))):
            stamps["sec"], stamps["nanosec"] = seconds[part], nanoseconds[part]
        doubles = np.ndarray((frames, 7), np.float64, self._buffer, self._head - 56, (self._stride, 8))
        doubles[:, 0:2] = poses_xyyaw[:, 0:2]
        doubles[:, 5] = np.sin(0.5 * poses_xyyaw[:, 2])
        doubles[:, 6] = np.cos(0.5 * poses_xyyaw[:, 2])
        return bytes(memoryview(self._buffer)[:size])

    def _template(self, poses: int) -> bytes:
        return bytes(self._serialise(plain_path(self._frame_id, 0, np.zeros(poses, np.int64), np.zeros((poses, 3)))))

    def _stamps(self, offset: int, count: int) -> np.ndarray:
        """A view ``(count,)`` of the stamps that begin at ``offset`` and follow each other by the stride."""
        stamp = np.dtype([("sec", np.int32), ("nanosec", np.uint32)])
        return np.ndarray((count,), stamp, self._buffer, offset, (self._stride,))

    def _check_layout(self) -> None:
        """Other middleware may serialise differently: write a template's worth and compare what arrives."""
        stamps_ns = np.array([1_000_000_002, 3_000_000_004, 5_000_000_006], dtype=np.int64)
        poses_xyyaw = np.arange(1.0, 10.0).reshape(3, 3)
        read = deserialize_message(self.write(7, stamps_ns, poses_xyyaw), Path)
        if read != plain_path(self._frame_id, 7, stamps_ns, poses_xyyaw):
            raise RuntimeError("this middleware's serialised nav_msgs/Path is not laid out as plain CDR")


def plain_path(frame_id: str, stamp_ns: int, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> Path:
    """The same message built pose by pose: the slow definition of what ``PathWriter`` writes."""
    poses = []
    for pose_stamp_ns, (x, y, yaw) in zip(stamps_ns, poses_xyyaw, strict=True):
        orientation = Quaternion(z=float(np.sin(0.5 * yaw)), w=float(np.cos(0.5 * yaw)))
        pose = Pose(position=Point(x=float(x), y=float(y)), orientation=orientation)
        poses.append(PoseStamped(header=Header(stamp=_time(int(pose_stamp_ns)), frame_id=frame_id), pose=pose))
    return Path(header=Header(stamp=_time(stamp_ns), frame_id=frame_id), poses=poses)


def _aligned(size: int, boundary: int) -> int:
    return -(-size // boundary) * boundary


def _time(stamp_ns: int) -> Time:
    return Time(sec=stamp_ns // _NS, nanosec=stamp_ns % _NS)
