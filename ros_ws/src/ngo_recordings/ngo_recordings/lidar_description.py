"""What a recording has of a lidar, in words: for those who run an estimator on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import islice

import numpy as np

from ngo_recordings.association import header_stamp_ns
from ngo_recordings.errors import RecordingError
from ngo_recordings.images import SCAN_TYPE
from ngo_recordings.mounting import Mounting, find_mounting
from ngo_recordings.recording import Recording
from ngo_recordings.scan_stream import ScanAngles, scan_angles
from ngo_recordings.topics import RecordingTopics, WheelSource

_LOOK = 200


@dataclass(frozen=True)
class LidarDescription:
    """The lidar of a recording.

    rays, angles, field_of_view (rad) and range_max (m) are those of the first scan. rate_hz: from the median step
    between the first 200 stamps; None where stamps do not tell it. mounting, wheels: None where there are none.
    stamps: "recorded", "made from the order of messages", or "none". notes: sentences with what to look at.
    """

    scan_topic: str
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
    notes: tuple[str, ...]

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
            *(f"note: {note}" for note in self.notes),
        ]


def describe_lidar(recording: Recording, topics: RecordingTopics) -> LidarDescription:
    """Scans, mounting, wheels and stamps of a recording; reads its first 200 scans and what the mounting takes.

    Raises:
        RecordingError: topics.image is no LaserScan, or its first scan is damaged.
    """
    info = recording.topics[topics.image]
    if info.type_name != SCAN_TYPE:
        raise RecordingError(f"topic {topics.image} is {info.type_name}; expected {SCAN_TYPE}")
    first = [message.value for message in islice(recording.messages([topics.image]), _LOOK)]
    angles = scan_angles(first[0], topics.image)
    stamps = np.array([header_stamp_ns(value) for value in first], np.int64)
    steps = np.diff(stamps)
    notes = [*recording.notes, *([] if angles.note is None else [angles.note])]
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
        scans=info.count,
        rays=len(first[0].ranges),
        angles=angles,
        field_of_view=abs(angles.angle_increment) * (len(first[0].ranges) - 1),
        range_max=float(first[0].range_max),
        rate_hz=rate,
        mounting=find_mounting(recording, topics),
        wheels=wheels,
        wheel_poses=recording.topics[wheels.topic].count if wheels is not None and wheels.topic is not None else 0,
        stamps=kind,
        notes=tuple(notes),
    )
