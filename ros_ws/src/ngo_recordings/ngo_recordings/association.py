"""What else is known about a frame, found by stamps while messages stream by; little is kept at a time."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np

from ngo_recordings.errors import RecordingError
from ngo_recordings.poses import Pose, PoseTrack, TransformTree, make_pose

if TYPE_CHECKING:  # live nodes need no files
    from ngo_recordings.recording import Message

RESTART_NS = 1_000_000_000
"""Stamps that jump back this far belong to a source that restarted, as the estimators have it."""

KEEP_NS = 5_000_000_000
"""How long side information is kept for images that are recorded later than it."""

_END_OF_TIME_S = 2**32

Value = TypeVar("Value")


class Side(Protocol):
    """One kind of side information."""

    def restarts(self, message: Message) -> bool:
        """Whether the source of this message started anew."""
        ...

    def add(self, message: Message) -> None:
        """Take a message."""
        ...

    def knows(self, before_ns: int | None, stamp_ns: int) -> bool:
        """Whether nothing more will come that matters for the frame at stamp_ns after the one at before_ns."""
        ...

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what is older."""
        ...

    def clear(self) -> None:
        """Drop what belongs to the source before its restart."""
        ...


class Series(Generic[Value]):
    """Values by stamp, rising."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.values: list[Value] = []
        self.newest_ns: int | None = None

    def add(self, stamp_ns: int, value: Value) -> None:
        """Add a value at its place."""
        index = bisect_right(self.stamps, stamp_ns)
        self.stamps.insert(index, stamp_ns)
        self.values.insert(index, value)
        self.newest_ns = self.stamps[-1]

    def nearest(self, stamp_ns: int, within_ns: int) -> Value | None:
        """The value whose stamp is nearest, if it is near enough; of several, the first."""
        index = bisect_left(self.stamps, stamp_ns)
        near = [i for i in (index, index - 1) if 0 <= i < len(self.stamps)]
        best = min(near, key=lambda i: abs(self.stamps[i] - stamp_ns), default=None)
        return self.values[best] if best is not None and abs(self.stamps[best] - stamp_ns) <= within_ns else None

    def has(self, stamp_ns: int) -> bool:
        """Whether there is a value of exactly this stamp."""
        index = bisect_left(self.stamps, stamp_ns)
        return index < len(self.stamps) and self.stamps[index] == stamp_ns

    def reached(self, stamp_ns: int) -> bool:
        """Whether the newest stamp is there or beyond."""
        return self.newest_ns is not None and self.newest_ns >= stamp_ns

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what is older."""
        keep = bisect_left(self.stamps, stamp_ns)
        if keep:
            del self.stamps[:keep], self.values[:keep]

    def clear(self) -> None:
        """Drop all."""
        self.stamps.clear()
        self.values.clear()
        self.newest_ns = None


class _SeriesSide(Generic[Value]):
    """What depth, actions and velocities have in common."""

    def __init__(self, keep_ns: int) -> None:
        self._series: Series[Value] = Series()
        self._keep_ns = keep_ns

    def stamp_ns(self, message: Message) -> int:
        """Of the header; a message without one is stamped with its log time."""
        return header_stamp_ns(message.value) if hasattr(message.value, "header") else message.log_time_ns

    def value(self, message: Message) -> Value:
        """What is kept of a message."""
        raise NotImplementedError

    def restarts(self, message: Message) -> bool:
        """Whether the stamp jumps back."""
        newest_ns = self._series.newest_ns
        return newest_ns is not None and self.stamp_ns(message) <= newest_ns - RESTART_NS

    def add(self, message: Message) -> None:
        """Keep a message."""
        self._series.add(self.stamp_ns(message), self.value(message))
        self._series.forget_before(self._series.stamps[-1] - KEEP_NS)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what is older by more than the longest tolerance."""
        self._series.forget_before(stamp_ns - self._keep_ns)

    def clear(self) -> None:
        """Drop all."""
        self._series.clear()


class Actions(_SeriesSide[int]):
    """Actions, each stamped with the frame at which it was taken."""

    def __init__(self, tolerance_ns: int) -> None:
        super().__init__(keep_ns=tolerance_ns)
        self._tolerance_ns = tolerance_ns

    def value(self, message: Message) -> int:
        """The action's number."""
        return int(message.value.action)

    def knows(self, before_ns: int | None, stamp_ns: int) -> bool:
        """The action at the frame before is there, or can come no more."""
        if before_ns is None or self._series.has(before_ns):
            return True
        return self._series.reached(before_ns + self._tolerance_ns)

    def step(self, before_ns: int, stamp_ns: int) -> int | None:
        """The action that led from one frame to the next; one that is nearer to the next is that one's."""
        return self._series.nearest(before_ns, min(self._tolerance_ns, max(0, (stamp_ns - before_ns - 1) // 2)))


class Twists(_SeriesSide[np.ndarray]):
    """Velocities ``(3,)``: forward and left in m/s, counter-clockwise in rad/s."""

    def __init__(self, tolerance_ns: int) -> None:
        super().__init__(keep_ns=tolerance_ns)
        self._tolerance_ns = tolerance_ns

    def value(self, message: Message) -> np.ndarray:
        """Of a Twist, a TwistStamped or an Odometry."""
        twist = message.value
        while hasattr(twist, "twist"):
            twist = twist.twist
        return np.array([twist.linear.x, twist.linear.y, twist.angular.z])

    def knows(self, before_ns: int | None, stamp_ns: int) -> bool:
        """All of the step are there."""
        return before_ns is None or self._series.reached(stamp_ns)

    def step(self, before_ns: int, stamp_ns: int) -> np.ndarray | None:
        """Mean of those stamped after before_ns and up to stamp_ns; where there is none, the newest one before."""
        first, last = bisect_right(self._series.stamps, before_ns), bisect_right(self._series.stamps, stamp_ns)
        if first < last:
            return np.asarray(np.mean(self._series.values[first:last], axis=0))
        if last and stamp_ns - self._series.stamps[last - 1] <= self._tolerance_ns:
            return self._series.values[last - 1]
        return None


class Depths(_SeriesSide[Any]):
    """Depth images, as messages: one is decoded only when its picture is there."""

    def __init__(self, tolerance_ns: int) -> None:
        super().__init__(keep_ns=tolerance_ns)
        self._tolerance_ns = tolerance_ns

    def value(self, message: Message) -> Any:
        """The message itself."""
        return message.value

    def knows(self, before_ns: int | None, stamp_ns: int) -> bool:
        """The depth of the frame is there, or can come no more."""
        return self._series.has(stamp_ns) or self._series.reached(stamp_ns + self._tolerance_ns)

    def at(self, stamp_ns: int) -> Any:
        """The depth message of a frame, or None."""
        return self._series.nearest(stamp_ns, self._tolerance_ns)


class TruePoses:
    """Ground truth of a topic, or of a file that is there from the beginning."""

    def __init__(self, gap_ns: int, from_file: PoseTrack | None = None) -> None:
        self._track = PoseTrack(gap_ns) if from_file is None else from_file
        self._complete = from_file is not None

    def restarts(self, message: Message) -> bool:
        """Whether the stamp jumps back."""
        newest_ns = self._track.newest_ns
        return newest_ns is not None and header_stamp_ns(message.value) <= newest_ns - RESTART_NS

    def add(self, message: Message) -> None:
        """Take a pose."""
        value = message.value
        while hasattr(value, "pose"):
            value = value.pose
        pose = ros_pose(value.position, value.orientation)
        if pose is not None:
            stamp_ns = header_stamp_ns(message.value)
            self._track.add(stamp_ns, pose)
            self._track.forget_before(stamp_ns - KEEP_NS)

    def knows(self, before_ns: int | None, stamp_ns: int) -> bool:
        """A pose of this stamp or after it is there."""
        return self._complete or (self._track.newest_ns is not None and self._track.newest_ns >= stamp_ns)

    def at(self, stamp_ns: int) -> Pose | None:
        """The true pose of a frame."""
        return self._track.at(stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what is older."""
        if not self._complete:
            self._track.forget_before(stamp_ns)

    def clear(self) -> None:
        """Drop all."""
        self._track.clear()


class TrueTransforms:
    """Ground truth from transforms: the pose of the child frame in the parent frame."""

    def __init__(self, parent: str, child: str, gap_ns: int) -> None:
        self._parent, self._child = parent, child
        self._tree = TransformTree(gap_ns)

    def restarts(self, message: Message) -> bool:
        """Whether the stamps of a transform of the chain jump back; other transforms may be as late as they like."""
        newest_ns = self._tree.newest_ns(self._parent, self._child)
        if not newest_ns or _is_static(message):
            return False
        return any(
            header_stamp_ns(each) <= newest_ns.get(each.child_frame_id.strip("/"), 0) - RESTART_NS
            for each in message.value.transforms
        )

    def add(self, message: Message) -> None:
        """Take all transforms of a message."""
        for each in message.value.transforms:
            pose = ros_pose(each.transform.translation, each.transform.rotation)
            if pose is not None:
                parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
                self._tree.add(parent, child, header_stamp_ns(each), pose, _is_static(message))
                if not _is_static(message):
                    self._tree.forget_before(header_stamp_ns(each) - KEEP_NS, child)

    def knows(self, before_ns: int | None, stamp_ns: int) -> bool:
        """Every transform of the chain is there at this stamp or after it."""
        until_ns = self._tree.known_until_ns(self._parent, self._child)
        return until_ns is not None and until_ns >= stamp_ns

    def at(self, stamp_ns: int) -> Pose | None:
        """The true pose of a frame."""
        return self._tree.lookup(self._parent, self._child, stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what is older."""
        self._tree.forget_before(stamp_ns)

    def clear(self) -> None:
        """Drop what moves."""
        self._tree.clear()


def header_stamp_ns(value: Any) -> int:
    """Stamp of a message's header, ns. Raises RecordingError where it is before 1970 or no stamp at all."""
    stamp = value.header.stamp
    sec, nanosec = int(stamp.sec), int(stamp.nanosec)
    if not (0 <= sec < _END_OF_TIME_S and 0 <= nanosec < 2**32):
        raise RecordingError(f"a stamp is {sec} s and {nanosec} ns; expected at least 0 s, and at most 32 bits of each")
    return sec * 1_000_000_000 + nanosec


def ros_pose(position: Any, orientation: Any) -> Pose | None:
    """Of a ROS position and quaternion; None where they are no numbers."""
    return make_pose((position.x, position.y, position.z), (orientation.x, orientation.y, orientation.z, orientation.w))


def _is_static(message: Message) -> bool:
    return message.topic.endswith("static")
