"""Where the scanner sits on the robot, from the recording's transforms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ngo_recordings.association import ros_pose
from ngo_recordings.poses import Pose, TransformTree
from ngo_recordings.recording import Recording
from ngo_recordings.topics import TF_TYPE, RecordingTopics

# Between these and the robot a transform moves: it says nothing of the robot itself.
_OUTSIDE = ("odom", "map", "world", "earth")
_BASE_FRAMES = ("base_link", "base_footprint", "base")
# How much of /tf is looked through for a scanner that /tf_static does not know.
_LOOK_NS = 60_000_000_000


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

    def __str__(self) -> str:
        x, y, yaw = self.base_from_scan_xyyaw.tolist()
        tilt = f", tilted by {math.degrees(self.tilt_rad):.1f} deg" if self.tilt_rad > math.radians(1.0) else ""
        return (
            f"{self.scan_frame} in {self.base_frame} at x {x:.3f} m, y {y:.3f} m, yaw {math.degrees(yaw):.1f} deg"
            f"{', upside down' if self.upside_down else ''}{tilt} (from {self.source})"
        )


def find_mounting(recording: Recording, topics: RecordingTopics) -> Mounting | None:
    """Where the scanner of topics.image sits on the robot; None where no transform says it.

    Chains of transforms are composed. Those of /tf_static count; where they do not join the two frames, the first
    transforms of /tf (60 s of it) are taken, without those that move the robot itself. The robot's frame is the child
    of the wheel odometry, else base_link, base_footprint or base.

    Raises:
        RecordingError: a message that cannot be read.
    """
    scan_frame = _scan_frame(recording, topics)
    bases = [frame for frame in (_wheel_frame(recording, topics), *_BASE_FRAMES) if frame]
    tree = TransformTree(0)
    names = [name for name, info in recording.topics.items() if info.type_name == TF_TYPE and info.count]
    static = [name for name in names if name.endswith("static")]
    for _, each in _transforms(recording, static):
        _add(tree, each)
    if (found := _lookup(tree, bases, scan_frame, ", ".join(static))) is not None:
        return found
    moving = [name for name in names if name not in static]
    known = set(tree.frames())
    start_ns: int | None = None
    for log_time_ns, each in _transforms(recording, moving):
        start_ns = log_time_ns if start_ns is None else start_ns
        if log_time_ns > start_ns + _LOOK_NS:
            break
        parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
        if parent in _OUTSIDE or child in known:
            continue
        known.add(child)
        _add(tree, each)
        if (found := _lookup(tree, bases, scan_frame, ", ".join(moving))) is not None:
            return found
    # A scanner whose frame is the robot's own needs no transform.
    if scan_frame in bases[:1]:
        return Mounting(scan_frame, scan_frame, np.zeros(3), False, 0.0, 0.0, "the scan's own frame")
    return None


def mounting_in(tree: TransformTree, base: str, scan_frame: str, source: str = "/tf_static") -> Mounting | None:
    """Where `scan_frame` sits on `base`, by the static transforms of a tree; None where they do not join the two."""
    return _lookup(tree, [base], scan_frame, source)


def _scan_frame(recording: Recording, topics: RecordingTopics) -> str:
    first = recording.first(topics.image)
    return str(first.value.header.frame_id).strip("/")


def _wheel_frame(recording: Recording, topics: RecordingTopics) -> str:
    if topics.wheels is None:
        return ""
    if topics.wheels.tf is not None:
        return topics.wheels.tf[1]
    first = recording.first(str(topics.wheels.topic))
    return str(first.value.child_frame_id).strip("/")


def _transforms(recording: Recording, names: list[str]) -> Iterator[tuple[int, Any]]:
    for message in recording.messages(names):
        for each in message.value.transforms:
            yield message.log_time_ns, each


def _add(tree: TransformTree, each: Any) -> None:
    pose = ros_pose(each.transform.translation, each.transform.rotation)
    if pose is not None:
        tree.add(each.header.frame_id.strip("/"), each.child_frame_id.strip("/"), 0, pose, static=True)


def _lookup(tree: TransformTree, bases: list[str], scan_frame: str, source: str) -> Mounting | None:
    frames = tree.frames()
    for base in bases:
        if base in frames and scan_frame in frames and (pose := tree.lookup(base, scan_frame, 0)) is not None:
            return _mounting(base, scan_frame, pose, source)
    return None


def _mounting(base: str, scan_frame: str, pose: Pose, source: str) -> Mounting:
    up = float(pose.rotation.as_matrix()[2, 2])
    planar, left_out = pose.planar()
    tilt = math.acos(min(1.0, abs(up)))
    return Mounting(base, scan_frame, planar, up < 0.0, tilt, float(left_out[0]), source)
