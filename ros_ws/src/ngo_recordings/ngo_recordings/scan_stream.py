"""A recording as scans, wheel poses and readings of an IMU in order of time, for estimators that use them."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ngo_recordings.association import RESTART_NS, header_stamp_ns
from ngo_recordings.errors import RecordingError
from ngo_recordings.imu import recorded_pose, up_axis, up_direction, yaw_rate
from ngo_recordings.laser_scan import LEAST_INCREMENT, LidarScan, is_increment
from ngo_recordings.odometry_poses import OdometryPoses
from ngo_recordings.space_scan import scan_reader
from ngo_recordings.topics import RecordingTopics, WheelSource, transform_topics
from ngo_recordings.transform_buffer import FramePoses, TransformBuffer

if TYPE_CHECKING:  # live nodes need no files
    from ngo_recordings.recording import Message, Recording

__all__ = ["BAD_SCAN", "BAD_WHEELS", "ImuReading", "LidarScan", "WheelPose", "scan_stream", "wheel_poses"]

BAD_SCAN = "damaged scan"
BAD_WHEELS = "wheel pose that is no number"
BAD_IMU = "reading of the IMU without a stamp"

# How late a message may be recorded after one with a later stamp, and still come in order.
_WAIT_NS = 1_000_000_000
# Between the stamps of scans and wheels that were recorded at once: of one clock they are not so far apart.
_OTHER_CLOCK_NS = 10_000_000_000


@dataclass(frozen=True)
class WheelPose:
    """Pose of the wheel odometry in its own frame, ``pose_xyyaw`` ``(3,)``: m, m, rad."""

    stamp_ns: int
    pose_xyyaw: np.ndarray


@dataclass(frozen=True)
class ImuReading:
    """Turn rate of an IMU about the robot's z, counter-clockwise, ``rate_rps``: rad/s; and the world's ``up`` in the
    robot's axes ``(3,)``, None where the IMU does not know it."""

    stamp_ns: int
    rate_rps: float
    up: np.ndarray | None = None


def scan_stream(
    recording: Recording,
    topics: RecordingTopics,
    angle_increment: float | None = None,
    skipped: Counter[str] | None = None,
    wheels_ahead_s: float | None = None,
) -> Iterator[LidarScan | WheelPose | ImuReading]:
    """Scans of topics.scans, poses of topics.wheels and rates of topics.imu in order of their stamps; at equal stamps
    scans come last.

    A message that was recorded up to 1 s after one with a later stamp comes at its place. Stamps that jump back by 1 s
    begin anew, as a source that restarted does.

    Args:
        angle_increment: rad, instead of that of the messages; None: see `scan_angles`.
        wheels_ahead_s: how far the stamps of the wheels are ahead, which come in the order of the scans' clock then.
            None: not known; clocks that are far apart are told by when the first messages were recorded.
        skipped: counts what gave no record, by the reason (BAD_SCAN, BAD_WHEELS, BAD_IMU). None: a damaged scan is
            an error, and poses that are no numbers are left out.

    Raises:
        RecordingError: topics.image holds no scans, or one is damaged.
    """
    readers = {topic: scan_reader(recording, topic, angle_increment) for topic in topics.scans}
    if angle_increment is not None and not is_increment(angle_increment, 1):
        raise RecordingError(f"the increment is {angle_increment:g} rad; expected at least {LEAST_INCREMENT:g} rad")
    wheels = None if topics.wheels is None else _Wheels(recording, topics.wheels, topics.image)
    names = {*topics.scans, *(wheels.names if wheels is not None else ())}
    if topics.imu is not None:
        names.add(topics.imu)
        imu_pose = recorded_pose(recording, topics)
        up = up_axis(imu_pose)
    lost: Counter[str] = Counter() if skipped is None else skipped
    waiting: list[tuple[int, bool, int, int, LidarScan | WheelPose | ImuReading]] = []
    newest: dict[str, int] = {}
    late: dict[bool, int] = {}
    ahead_ns = 0 if wheels_ahead_s is None else round(wheels_ahead_s * 1e9)
    for order, message in enumerate(recording.messages(names)):
        is_scan = message.topic in topics.scans
        try:
            found: list[LidarScan | WheelPose | ImuReading]
            if is_scan:
                found = [readers[message.topic](message.value)]
            elif message.topic == topics.imu:
                rate_rps, direction = yaw_rate(message.value, up), up_direction(message.value, imu_pose)
                found = [ImuReading(header_stamp_ns(message.value), rate_rps, direction)]
            else:
                found = list(wheels.read(message, lost) if wheels else ())
        except AttributeError as error:
            raise RecordingError(f"a message of {message.topic} is not what its type should be ({error})") from None
        except RecordingError:
            if skipped is None:
                raise
            lost[BAD_SCAN if is_scan else BAD_WHEELS if message.topic != topics.imu else BAD_IMU] += 1
            continue
        for record in found:
            before = newest.get(message.topic)
            if before is not None and record.stamp_ns <= before - RESTART_NS:
                while waiting:
                    yield heapq.heappop(waiting)[-1]
                newest.clear()
            newest[message.topic] = max(record.stamp_ns, newest.get(message.topic, 0))
            if not isinstance(record, ImuReading):
                late.setdefault(is_scan, record.stamp_ns - message.log_time_ns)
            apart_ns = late[False] - late[True] if len(late) == 2 else 0
            if wheels_ahead_s is None and abs(apart_ns) > _OTHER_CLOCK_NS:
                ahead_ns = apart_ns
            key_ns = record.stamp_ns if is_scan else record.stamp_ns - ahead_ns
            heapq.heappush(waiting, (key_ns, is_scan, order, message.log_time_ns, record))
        while waiting and message.log_time_ns - waiting[0][3] > _WAIT_NS:
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]


def wheel_poses(recording: Recording, topics: RecordingTopics, skipped: Counter[str]) -> Iterator[WheelPose]:
    """Poses of topics.wheels in the order in which they were recorded; none where there are no wheels.

    Args:
        skipped: counts poses that are no numbers (BAD_WHEELS).
    """
    if topics.wheels is None:
        return
    wheels = _Wheels(recording, topics.wheels, topics.image)
    for message in recording.messages(wheels.names):
        try:
            yield from wheels.read(message, skipped)
        except (AttributeError, RecordingError):
            skipped[BAD_WHEELS] += 1


class _Wheels:
    """Wheel poses of messages."""

    def __init__(self, recording: Recording, source: WheelSource, image: str) -> None:
        self._odometry = OdometryPoses()
        self._tf = None if source.tf is None else FramePoses(TransformBuffer(), *source.tf)
        self.names = (str(source.topic),) if source.tf is None else tuple(transform_topics(recording, image))

    def read(self, message: Message, lost: Counter[str]) -> Iterator[WheelPose]:
        if self._tf is None:
            value = message.value
            pose = self._odometry.read(value)
            if pose is None:
                lost[BAD_WHEELS] += 1
            else:
                yield WheelPose(header_stamp_ns(value), pose)
            return
        bad = self._tf.bad
        for stamp_ns, found in self._tf.read(message.value.transforms, message.topic.endswith("static")):
            yield WheelPose(stamp_ns, found.planar()[0])
        if self._tf.bad > bad:
            lost[BAD_WHEELS] += self._tf.bad - bad
