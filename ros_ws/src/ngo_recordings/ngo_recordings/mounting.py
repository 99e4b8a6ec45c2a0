"""Where the scanner sits on the robot, from the recording's transforms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from ngo_recordings.poses import Pose
from ngo_recordings.space_scan import is_optical
from ngo_recordings.topics import RecordingTopics, transform_topics
from ngo_recordings.transform_buffer import TransformBuffer, is_named

if TYPE_CHECKING:  # live nodes need no files
    from ngo_recordings.recording import Recording

# Between these and the robot a transform moves: it says nothing of the robot itself.
_OUTSIDE = ("odom", "map", "world", "earth")
_BASE_FRAMES = ("base_link", "base_footprint", "base")
FLOOR_FRAME = "base_footprint"
"""Of a robot, where it is on the floor (REP-120)."""
# How much of /tf is looked through for a scanner that /tf_static does not know.
_LOOK_NS = 600_000_000_000


_OPTICAL_FROM_BODY = Pose(np.zeros(3), Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))

_CHANGES = "it changes on the way"

_NEAR_M, _NEAR_RAD = 0.01, math.radians(0.5)
"""Mountings that differ by less are the same."""


@dataclass(frozen=True)
class Mounting:
    """The scanner's pose on the robot.

    base_from_scan_xyyaw ``(3,)``: m, m, rad; yaw is the direction of the scan's x from above. upside_down: the scan's z
    points down, so that rays run clockwise seen from above. tilt_rad: between the scan's plane and the robot's, which
    planar use leaves out. height_m: of the scan's plane. source: the topic.
    """

    base_frame: str
    scan_frame: str
    base_from_scan_xyyaw: np.ndarray
    upside_down: bool
    tilt_rad: float
    height_m: float
    source: str

    def on_robot(self, points: np.ndarray) -> np.ndarray:
        """Points ``(n, 2)`` of the scan's plane, in the robot's frame."""
        x, y, yaw = self.base_from_scan_xyyaw.tolist()
        cos, sin = math.cos(yaw), math.sin(yaw)
        seen = points * (1.0, -1.0) if self.upside_down else points
        return np.asarray(seen @ np.array(((cos, sin), (-sin, cos))) + (x, y))

    def near(self, other: Mounting) -> bool:
        """Whether another mounting is the same but for rounding and vibration."""
        off = self.base_from_scan_xyyaw - other.base_from_scan_xyyaw
        turn = abs(math.remainder(float(off[2]), math.tau))
        return self.upside_down == other.upside_down and math.hypot(off[0], off[1]) < _NEAR_M and turn < _NEAR_RAD

    @property
    def changes(self) -> bool:
        """Whether the transforms say another one, too."""
        return self.source.endswith(_CHANGES)

    def __str__(self) -> str:
        x, y, yaw = self.base_from_scan_xyyaw.tolist()
        tilt = f", tilted by {math.degrees(self.tilt_rad):.1f} deg" if self.tilt_rad > math.radians(1.0) else ""
        return (
            f"{self.scan_frame} in {self.base_frame} at x {x:.3f} m, y {y:.3f} m, yaw {math.degrees(yaw):.1f} deg"
            f"{', upside down' if self.upside_down else ''}{tilt} (from {self.source})"
        )


def find_mounting(recording: Recording, topics: RecordingTopics, frame: str | None = None) -> Mounting | None:
    """Where the scanner of a frame (None: of topics.image) sits on the robot; None where no transform says it.

    See `find_pose` for what counts.

    Raises:
        RecordingError: a message that cannot be read.
    """
    found = find_pose(recording, topics, frame)
    return None if found is None else _mounting(*found)


def find_pose(
    recording: Recording, topics: RecordingTopics, frame: str | None = None, *before: str
) -> tuple[str, str, Pose, str] | None:
    """The robot's frame, that of a sensor (None: of topics.image), the sensor's pose there, and which topics say it.

    Chains of transforms are composed. Those of /tf_static count; where a frame's transform changes, the one that holds
    longest while topics.image is recorded. Where they do not join the two frames, the first transforms of /tf (10 min
    of it) are taken, without those that move the robot itself. The robot's frame is the child of the wheel odometry,
    else one of those before, base_link, base_footprint or base, with the robot's prefix where it has one. Topics of
    transforms in another robot's namespace are left out. None where no transform says it.

    Raises:
        RecordingError: a message that cannot be read.
    """
    scan_frame = _scan_frame(recording, topics) if frame is None else frame
    bases = [frame for frame in (_wheel_frame(recording, topics), *before, *_BASE_FRAMES) if frame]
    tree = TransformBuffer()
    names = transform_topics(recording, topics.image)
    static = [name for name in names if name.endswith("static")]
    held, changed = _held_longest(recording, static, topics.image)
    tree.take((said[0] for said in held), static=True)
    found = _lookup(tree, bases, scan_frame)
    source = ", ".join(static)
    for first, *others in held:
        for each in others if found is None else ():
            tree.take((each,), static=True)
            if (found := _lookup(tree, bases, scan_frame)) is not None:
                source += f", which gives {first.child_frame_id} several parents"
                changed.discard(first.child_frame_id.strip("/"))
                break
            tree.take((first,), static=True)
    if found is not None:
        source += ", whose transforms go round" if tree.parent(tree.root(scan_frame)) else ""
        if changed & set(tree.between(found[0], scan_frame)):
            source += f", as it was said for the longest time: {_CHANGES}"
        return found[0], scan_frame, found[1], source
    moving = [name for name in names if name not in static]
    start_ns: int | None = None
    for log_time_ns, each in _transforms(recording, moving):
        start_ns = log_time_ns if start_ns is None else start_ns
        if log_time_ns > start_ns + _LOOK_NS:
            break
        parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
        if tree.parent(child) is not None or any(is_named(parent, name, scan_frame) for name in _OUTSIDE):
            continue
        tree.take((each,), static=True)
        if (found := _lookup(tree, bases, scan_frame)) is not None:
            return found[0], scan_frame, found[1], ", ".join(moving)
    # A scanner whose frame is the robot's own needs no transform.
    if scan_frame in bases[:1]:
        return scan_frame, scan_frame, Pose(np.zeros(3), Rotation.identity()), "the scan's own frame"
    return None


def mounting_in(tree: TransformBuffer, base: str, scan_frame: str, source: str = "/tf_static") -> Mounting | None:
    """Where `scan_frame` sits on `base`, by what is known last; None where no transforms join the two."""
    found = _lookup(tree, [base], scan_frame)
    return None if found is None else _mounting(found[0], scan_frame, found[1], source)


def _scan_frame(recording: Recording, topics: RecordingTopics) -> str:
    first = recording.first(topics.image)
    return str(first.value.header.frame_id).strip("/")


def _wheel_frame(recording: Recording, topics: RecordingTopics) -> str:
    if topics.wheels is None:
        return ""
    if topics.wheels.tf is not None:
        return topics.wheels.tf[1]
    first = recording.first(str(topics.wheels.topic))
    return str(getattr(first.value, "child_frame_id", "")).strip("/")  # poses and velocities have none


def _transforms(recording: Recording, names: list[str]) -> Iterator[tuple[int, Any]]:
    for message in recording.messages(names):
        for each in message.value.transforms:
            yield message.log_time_ns, each


def _held_longest(recording: Recording, names: list[str], sensor: str) -> tuple[list[list[Any]], set[str]]:
    """The static transforms of each frame, first what holds longest while a sensor's topic is recorded, and which
    frames change."""
    spans_ns = recording.spans_ns(sensor)
    said: dict[str, list[tuple[int, Any]]] = {}
    for log_time_ns, each in _transforms(recording, names):
        said.setdefault(each.child_frame_id.strip("/"), []).append((log_time_ns, each))
    held, changed = [], set()
    for child, all_said in said.items():
        starts_ns = [0, *(time_ns for time_ns, _ in all_said[1:])]  # what is said first also held before
        total: dict[str, int] = {}
        last: dict[str, Any] = {}
        for (_, each), from_ns, until_ns in zip(all_said, starts_ns, [*starts_ns[1:], 2**63], strict=True):
            value = f"{each.header.frame_id} {each.transform}"
            held_ns = sum(max(0, min(until_ns, last + 1) - max(from_ns, first)) for first, last in spans_ns)
            total[value] = total.get(value, 0) + held_ns
            last[value] = each
        held.append([last[value] for value in sorted(total, key=lambda value: -total[value])])
        if len(total) > 1:
            changed.add(child)
    return held, changed


def _lookup(tree: TransformBuffer, bases: list[str], scan_frame: str) -> tuple[str, Pose] | None:
    """The first of the robot's frames that the sensor's is joined to, and its pose there."""
    for name in bases:
        base = tree.like(name, scan_frame)
        if base is None or any(
            is_named(part, each, scan_frame) for part in tree.between(base, scan_frame) for each in _OUTSIDE
        ):
            continue
        if (pose := tree.newest_lookup(base, scan_frame)) is not None:
            return base, pose
    return None


def _mounting(base: str, scan_frame: str, pose: Pose, source: str) -> Mounting:
    pose = pose @ _OPTICAL_FROM_BODY if is_optical(scan_frame) else pose
    up = float(pose.rotation.as_matrix()[2, 2])
    planar, left_out = pose.planar()
    tilt = math.acos(min(1.0, abs(up)))
    return Mounting(base, scan_frame, planar, up < 0.0, tilt, float(left_out[0]), source)
