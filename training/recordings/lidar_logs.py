"""Real logs of a lidar in a folder, each with the reference that belongs to it."""

import hashlib
from collections import Counter
from pathlib import Path

import numpy as np

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.association import header_stamp_ns, ros_pose
from ngo_recordings.carmen_log import CORRECTED_TOPIC
from ngo_recordings.mounting import find_mounting
from ngo_recordings.recording import Recording, open_recording
from ngo_recordings.scan_stream import LidarScan, WheelPose, scan_stream
from ngo_recordings.topics import TopicArguments, choose_topics
from training.data.lidar_drives import LidarDrive, ReferencePoses, Relations

_ENDINGS = (".bag", ".log", ".clf", ".log.gz", ".clf.gz")
_RELATION_COLUMNS = 8


def logs_below(folder: Path) -> dict[str, Path]:
    """The logs in a folder and its subfolders by their name, which is the file's up to its first dot."""
    found = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name.endswith(_ENDINGS)]
    return {path.name.partition(".")[0]: path for path in found}


def log_identity(path: Path) -> str:
    """What a drive by this log follows from, in words without its folder."""
    digests = [hashlib.sha256(part.read_bytes()).hexdigest() for part in (path, relations_of(path)) if part.is_file()]
    return f"log {path.name} {' '.join(digests)}"


def log_drive(path: Path) -> LidarDrive:
    """The log as a drive: by relations in ``NAME.relations`` beside it, else by the poses of the mapper that wrote it.

    Raises:
        ValueError: the log has no reference, or its relations are no rows of 8 numbers.
        RecordingError: the log cannot be read.
    """
    drive = read_drive(path)
    if drive.reference is None:
        raise ValueError(f"{path.name} has neither {relations_of(path).name} beside it nor poses of a mapper")
    return drive


def read_drive(path: Path, with_relations: bool = True) -> LidarDrive:
    """The log as a drive, with its reference if there is one: without relations a mapper's; raises as `log_drive`."""
    with open_recording([path]) as recording:
        topics = choose_topics(recording, TopicArguments())
        found = find_mounting(recording, topics)
        records = list(scan_stream(recording, topics, skipped=Counter()))
        reference = _reference(path, recording, with_relations)
    return LidarDrive(
        path.name.partition(".")[0],
        log_identity(path),
        tuple(record for record in records if isinstance(record, LidarScan)),
        tuple(record for record in records if isinstance(record, WheelPose)),
        Mounting(np.zeros(3)) if found is None else Mounting(found.base_from_scan_xyyaw, found.upside_down),
        reference,
    )


def read_relations(path: Path) -> Relations:
    """Relations as the Freiburg SLAM benchmark gives them: ``stamp stamp x y z roll pitch yaw`` in each line.

    Raises:
        ValueError: a line has another number of columns.
    """
    table = np.loadtxt(path, ndmin=2)
    if table.shape[1] != _RELATION_COLUMNS:
        raise ValueError(f"{path.name} has {table.shape[1]} columns; expected {_RELATION_COLUMNS}")
    return Relations(table[:, :2], table[:, [2, 3, 7]])


def relations_of(path: Path) -> Path:
    """Where the relations of a log are, if it has any."""
    return path.with_name(path.name.partition(".")[0] + ".relations")


def _reference(path: Path, recording: Recording, with_relations: bool) -> Relations | ReferencePoses | None:
    if with_relations and (relations := relations_of(path)).is_file():
        return read_relations(relations)
    if CORRECTED_TOPIC not in recording.topics:
        return None
    stamps_ns, poses = [], []
    for message in recording.messages([CORRECTED_TOPIC]):
        pose = ros_pose(message.value.pose.position, message.value.pose.orientation)
        if pose is not None:
            stamps_ns.append(header_stamp_ns(message.value))
            poses.append(pose.planar()[0])
    return ReferencePoses(np.array(stamps_ns, dtype=np.int64), np.array(poses))
