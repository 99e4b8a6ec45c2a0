"""Transforms as they come, for nodes and recordings alike: chains, interpolation, bounded memory, what is missing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from ngo_recordings.association import RESTART_NS, header_stamp_ns, ros_pose
from ngo_recordings.errors import RecordingError
from ngo_recordings.poses import Pose, TransformTree

_GAP_NS = 5_000_000_000
"""Between two transforms of a frame that are interpolated: odometry of 1 Hz is one, a pause is none."""

_KEPT_NS = 30_000_000_000
"""How long a transform is kept behind the newest of its frame."""

_NEVER_ENDS = 2**63 - 1
"""Until when a chain of static transforms is known."""


class TransformBuffer(TransformTree):
    """A tree that takes the transforms of messages in bounded memory.

    A frame whose stamps jump back by ``RESTART_NS`` begins anew, as its publisher did. Names lose their outer slashes.
    """

    def __init__(self, gap_ns: int = _GAP_NS) -> None:
        super().__init__(gap_ns)
        self._newest: dict[str, int] = {}

    def take(self, transforms: Iterable[Any], static: bool) -> int:
        """Take the transforms of a message; returns how many of them are no numbers, or have no stamp."""
        bad = 0
        for each in transforms:
            pose = ros_pose(each.transform.translation, each.transform.rotation)
            parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
            try:
                stamp_ns = 0 if static else header_stamp_ns(each)
            except RecordingError:
                pose = None
            if pose is None or not parent or not child or parent == child:
                bad += 1
                continue
            if not static:
                newest_ns = self._newest.get(child, stamp_ns)
                if stamp_ns <= newest_ns - RESTART_NS:
                    self.clear(child)
                    newest_ns = stamp_ns
                self._newest[child] = max(stamp_ns, newest_ns)
            self.add(parent, child, stamp_ns, pose, static)
            if not static:
                self.forget_before(stamp_ns - _KEPT_NS, child)
        return bad

    def newest_lookup(self, target: str, source: str) -> Pose | None:
        """Pose of frame source in frame target as it is known last; None where no chain joins them."""
        until_ns = self.known_until_ns(target, source)
        return None if until_ns is None else self.lookup(target, source, until_ns)

    def like(self, name: str, joined_to: str) -> str | None:
        """The frame of this name that is joined to another one, also with that one's prefix, as in ``robot1/odom``.

        Of several the next above the other one; None where there is none, or none that is clear.
        """
        above = [frame for frame in self.above(joined_to) if is_named(frame, name, joined_to)]
        if name in above or not above:
            if name in self.frames() and self.joined(name, joined_to):
                return name
            named = [frame for frame in self.frames() if is_named(frame, name, joined_to)]
            above = [frame for frame in named if self.joined(frame, joined_to)]
            return above[0] if len(above) == 1 else None
        return above[0]

    def missing(self, target: str, source: str, stamp_ns: int) -> str:
        """Why the pose of frame source in frame target isn't known at a stamp: frames, newest stamps and their
        distance; nothing where it is known."""
        frames = self.frames()
        if absent := [name for name in (target, source) if name not in frames]:
            there = ", ".join(sorted(frames)) or "none"
            return f"no transform has the frame {' or '.join(map(repr, absent))}; frames that came: {there}"
        newest_ns = self.newest_ns(target, source)
        if newest_ns is None:
            tops = " and ".join(f"'{name}' is below '{self.root(name)}'" for name in (target, source))
            return f"no transform joins '{target}' and '{source}': {tops}"
        if self.lookup(target, source, stamp_ns) is not None:
            return ""
        parts = [_distance(child, newest, stamp_ns) for child, newest in sorted(newest_ns.items())]
        return f"'{source}' in '{target}' is not known at {stamp_ns * 1e-9:.3f} s: {', '.join(parts)}"


class FramePoses:
    """The pose of one frame in another, at each stamp at which it becomes known.

    ``bad``: transforms between the two that are no numbers.
    """

    def __init__(self, buffer: TransformBuffer, parent: str, child: str) -> None:
        self._buffer, self._frames = buffer, (parent, child)
        self._last_ns = -1
        self.bad = 0

    def read(self, transforms: list[Any], static: bool) -> Iterator[tuple[int, Pose]]:
        """Take the transforms of a message into the buffer, and give what becomes known with it."""
        direct = False
        for each in transforms:
            bad = self._buffer.take((each,), static)
            if (each.header.frame_id.strip("/"), each.child_frame_id.strip("/")) != self._frames:
                continue
            direct, self.bad = True, self.bad + bad
            if not static and not bad:  # also what comes late: those who take it put it at its place
                pose = ros_pose(each.transform.translation, each.transform.rotation)
                if pose is not None:
                    yield header_stamp_ns(each), pose
        if not direct and not static:
            yield from self._chain()

    def _chain(self) -> Iterator[tuple[int, Pose]]:
        """The chain is known up to the transform that lags most: one pose for each of its stamps."""
        if self._buffer.parent(self._frames[1]) == self._frames[0]:
            return
        known_ns = self._buffer.known_until_ns(*self._frames)
        if known_ns is None or not 0 <= known_ns < _NEVER_ENDS:
            return
        if known_ns <= self._last_ns - RESTART_NS:
            self._last_ns = -1
        if known_ns > self._last_ns and (found := self._buffer.lookup(*self._frames, known_ns)) is not None:
            self._last_ns = known_ns
            yield known_ns, found


def is_named(frame: str, name: str, beside: str = "") -> bool:
    """Whether a frame has a name, maybe with a robot's prefix: ``robot1/odom``, ``r1_odom`` beside ``r1_laser``."""
    prefix = frame.removesuffix(name)
    if frame == name or not frame.endswith(name):
        return frame == name
    return prefix.endswith("/") or (prefix.endswith("_") and beside.startswith(prefix))


def _distance(child: str, newest_ns: int, stamp_ns: int) -> str:
    off_s = (newest_ns - stamp_ns) * 1e-9
    side = "older" if off_s < 0.0 else "newer"
    return f"the newest transform of '{child}' is at {newest_ns * 1e-9:.3f} s, {abs(off_s):.3f} s {side}"
