"""What a recording has of a lidar, in words: for those who run an estimator on it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ngo_recordings.errors import RecordingError
from ngo_recordings.images import LIDAR_TYPES
from ngo_recordings.laser_scan import LidarScan, ScanAngles, scan_angles
from ngo_recordings.mounting import Mounting, find_mounting
from ngo_recordings.recording import Recording
from ngo_recordings.space_scan import scan_reader
from ngo_recordings.topics import RecordingTopics, WheelSource, odometry_to_name, wheel_candidates

_LOOK = 200


@dataclass(frozen=True)
class LidarDescription:
    """The lidar of a recording.

    rays, angles, field_of_view (rad) and range_max (m) are those of the first scan. rate_hz: from the median step
    between the first 200 stamps; None where stamps do not tell it. mounting, wheels: None where there are none.
    stamps: "recorded", "made from the order of messages", or "none". imu: topic and rate, nothing where
    there is none. notes: sentences with what to look at.
    """

    scan_topic: str
    scan_frame: str
    scans: int
    rays: int
    angles: ScanAngles
    field_of_view: float
    range_max: float
    rate_hz: float | None
    mounting: Mounting | None
    wheels: WheelSource | None
    wheel_poses: int
    stamps: str
    imu: str
    notes: tuple[str, ...]

    def looking_at(self, yaw_rad: float) -> LidarDescription:
        """The description with a scanner whose angle 0 points there (counter-clockwise from straight ahead)."""
        known = self.mounting or Mounting("the robot", "the scanner", np.zeros(3), False, 0.0, 0.0, "")
        turned = np.array([*known.base_from_scan_xyyaw[:2], yaw_rad])
        source = f"its place from {known.source}, " if known.source else ""
        source += "its direction as it was given"
        return replace(self, mounting=replace(known, base_from_scan_xyyaw=turned, source=source))

    def lines(self) -> list[str]:
        """The description for a person, one fact a line."""
        step = math.degrees(self.angles.angle_increment)
        rate = "at a rate that is not known" if self.rate_hz is None else f"at {self.rate_hz:.1f} Hz"
        wheels = "none" if self.wheels is None else f"{self.wheels}"
        if self.wheels is not None and self.wheels.topic is not None:
            wheels += f", {self.wheel_poses} poses"
        return [
            f"scans: {self.scan_topic}, {self.scans} {rate}, {self.rays} rays {step:.4f} deg apart over "
            f"{math.degrees(self.field_of_view):.1f} deg, to {self.range_max:g} m",
            f"mounting: {self.mounting if self.mounting is not None else 'not in the recording'}",
            f"wheels: {wheels}",
            f"stamps: {self.stamps}",
            *([f"IMU: {self.imu}"] if self.imu else ()),
            *(f"note: {note}" for note in self.notes),
        ]


def _first_scans(recording: Recording, topic: str) -> tuple[LidarScan, ScanAngles, list[int], int]:
    """The first usable scan, its angles, the stamps of the first ones, and how many beside them are damaged."""
    first, angles, damaged, last_error = None, None, 0, RecordingError(f"topic {topic} has no message")
    read, stamps = scan_reader(recording, topic), []
    for count, message in enumerate(recording.messages([topic])):
        if count >= _LOOK and first is not None:
            break
        try:
            scan = read(message.value)
        except RecordingError as error:
            damaged, last_error = damaged + 1, error
            continue
        stamps.append(scan.stamp_ns)
        if first is None or angles is None:
            of_laser = hasattr(message.value, "angle_min")
            angles = scan_angles(message.value, topic) if of_laser else ScanAngles(scan.angle_min, scan.angle_increment)
            first = scan
    if first is None or angles is None:
        raise last_error
    return first, angles, stamps, damaged


def _others(recording: Recording, topics: RecordingTopics, mounting: Mounting | None) -> list[str]:
    """A sentence on other scans, and one on other odometries, each with its rate."""
    scans = [name for name, info in recording.topics.items() if info.type_name in LIDAR_TYPES and info.count]
    wheels = wheel_candidates(recording, topics.image, topics.ground_truth)
    notes = []
    if more := [name for name in scans if name not in topics.scans]:
        others = ", ".join(_with_rate(recording, name) for name in more)
        used = ", ".join(topics.scans)
        notes.append(f"scans of {used} are used; others are {others}: --image names another one, --scan-topics several")
        frames = {str(recording.first(name).value.header.frame_id).strip("/") for name in more}
        if mounting is not None and mounting.changes and mounting.scan_frame in frames:
            notes.append(
                f"two scanners have the frame {mounting.scan_frame}, and it has two places: robots whose frames have "
                "the same names cannot be told apart, give each a prefix"
            )
    if topics.no_wheels:
        return notes
    if not wheels and (note := odometry_to_name(recording, topics, lambda name: _with_rate(recording, name))):
        notes.append(note)
    if len(wheels) > 1:
        taken = "no odometry" if topics.wheels is None else str(topics.wheels)
        there = ", ".join(_with_rate(recording, name) for name in wheels)
        notes.append(f"{taken} is used of {there}: --wheels names another one")
    return notes


def _with_rate(recording: Recording, name: str) -> str:
    info = recording.topics[name]
    span_s = (info.last_ns - info.first_ns) * 1e-9
    return f"{name} ({(info.count - 1) / span_s:.1f} Hz)" if span_s > 0.0 else f"{name} ({info.count} messages)"


def describe_lidar(recording: Recording, topics: RecordingTopics) -> LidarDescription:
    """Scans, mounting, wheels and stamps of a recording; reads its first 200 scans and what the mounting takes.

    Raises:
        RecordingError: topics.image holds no scans, or they are damaged.
    """
    info = recording.topics[topics.image]
    first, angles, stamps_ns, damaged = _first_scans(recording, topics.image)
    stamps = np.array(stamps_ns, np.int64)
    steps = np.diff(stamps)
    notes = [*recording.notes, *([] if angles.note is None else [angles.note])]
    if damaged:
        looked = max(_LOOK, damaged + len(stamps))
        notes.append(f"{damaged} of the first {looked} scans of {topics.image} are damaged and left out")
    mounting = find_mounting(recording, topics)
    notes += _others(recording, topics, mounting)
    if recording.stamps_made:
        kind = "made from the order of messages"
    elif len(stamps) > 1 and not steps.any():
        kind = "none"
        notes.append(f"scans of {topics.image} all have the stamp {stamps[0] / 1e9:g} s: the driver must stamp them")
    else:
        kind = "recorded"
    rate = 1e9 / float(np.median(steps)) if kind == "recorded" and len(steps) and np.median(steps) > 0 else None
    wheels = topics.wheels
    return LidarDescription(
        scan_topic=topics.image,
        scan_frame=first.frame_id,
        scans=info.count,
        rays=len(first.ranges),
        angles=angles,
        field_of_view=abs(angles.angle_increment) * (len(first.ranges) - 1),
        range_max=first.range_max,
        rate_hz=rate,
        mounting=mounting,
        wheels=wheels,
        wheel_poses=recording.topics[wheels.topic].count if wheels is not None and wheels.topic is not None else 0,
        stamps=kind,
        imu="" if topics.imu is None else _with_rate(recording, topics.imu),
        notes=tuple(notes),
    )
