"""ROS 1 bags are read through the same interface; damaged ones and bombs say so in one line."""

import bz2
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ngo_recordings.errors import RecordingError
from ngo_recordings.frames import frames
from ngo_recordings.mounting import find_mounting
from ngo_recordings.recording import TopicInfo, open_recording
from ngo_recordings.scan_stream import LidarScan, WheelPose, scan_stream
from ngo_recordings.topics import RecordingTopics, WheelSource, choose_topics

S = 10**9
STORE = get_typestore(Stores.ROS1_NOETIC)
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
for name in TF_TYPES:
    STORE.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))


def make(type_name: str, *args: Any) -> Any:
    return STORE.types[type_name](*args)


def header(stamp_ns: int, frame: str) -> Any:
    return make("std_msgs/msg/Header", 7, make("builtin_interfaces/msg/Time", stamp_ns // S, stamp_ns % S), frame)


def vector(kind: str, x: float, y: float, z: float) -> Any:
    return make(f"geometry_msgs/msg/{kind}", x, y, z)


def turned(yaw: float) -> Any:
    return make("geometry_msgs/msg/Quaternion", 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))


def scan(stamp_ns: int, ranges: np.ndarray) -> Any:
    values = (-1.0, 1.0, 2.0 / (len(ranges) - 1), 0.0, 0.1, 0.05, 30.0)
    empty = np.zeros(0, np.float32)
    return make("sensor_msgs/msg/LaserScan", header(stamp_ns, "/laser"), *values, ranges.astype(np.float32), empty)


def odometry(stamp_ns: int, x: float, y: float, yaw: float) -> Any:
    pose = make("geometry_msgs/msg/Pose", vector("Point", x, y, 0.0), turned(yaw))
    twist = make("geometry_msgs/msg/Twist", vector("Vector3", 0.0, 0.0, 0.0), vector("Vector3", 0.0, 0.0, 0.0))
    return make(
        "nav_msgs/msg/Odometry",
        header(stamp_ns, "odom"),
        "base_link",
        make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
        make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
    )


def transforms(type_name: str, stamp_ns: int, parent: str, child: str, x: float, y: float, yaw: float) -> Any:
    moved = make("geometry_msgs/msg/Transform", vector("Vector3", x, y, 0.0), turned(yaw))
    return make(type_name, [make("geometry_msgs/msg/TransformStamped", header(stamp_ns, parent), child, moved)])


def write_bag(path: Path, count: int = 20, tf: str = TF_TYPES[0], compression: str | None = None) -> Path:
    writer = Writer(path)
    writer.chunk_threshold = 3000
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connections: dict[str, Any] = {}

        def write(topic: str, time_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            data = STORE.serialize_ros1(message, message.__msgtype__)
            writer.write(connections[topic], time_ns, bytes(data))

        write("/tf_static", S, transforms(tf, 0, "base_link", "laser", 0.2, 0.0, np.pi / 2))
        for k in range(count):
            time_ns = S + k * S // 10
            write("/odom", time_ns, odometry(time_ns, 0.1 * k, -0.05 * k, 0.01 * k))
            write("/tf", time_ns, transforms(tf, time_ns, "odom", "base_link", 0.1 * k, -0.05 * k, 0.01 * k))
            write("/scan", time_ns + 1, scan(time_ns + 1, np.arange(1.0, 12.0) + k))
    return path


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_bag_is_read_as_frames_and_as_a_stream(tmp_path: Path, compression: str | None) -> None:
    with open_recording([write_bag(tmp_path / "a.bag", compression=compression)]) as recording:
        last_ns = S + 19 * S // 10
        assert recording.topics["/odom"] == TopicInfo("nav_msgs/msg/Odometry", 20, S, last_ns)
        assert recording.topics["/tf_static"] == TopicInfo("tf2_msgs/msg/TFMessage", 1, S, S)
        topics = choose_topics(recording)
        assert topics == RecordingTopics("/scan", wheels=WheelSource("/odom"))
        found = list(frames(recording, topics))
        assert [frame.stamp_ns for frame in found] == [S + k * S // 10 + 1 for k in range(20)]
        np.testing.assert_allclose(found[3].image[0, ::-1, 0], np.arange(1.0, 12.0) + 3)
        stream = list(scan_stream(recording, topics))
        scans = [each for each in stream if isinstance(each, LidarScan)]
        wheels = np.array([each.pose_xyyaw for each in stream if isinstance(each, WheelPose)])
        assert len(scans) == 20 and scans[0].frame_id == "laser"
        k = np.arange(20)
        np.testing.assert_allclose(wheels, np.stack((0.1 * k, -0.05 * k, 0.01 * k), axis=1), atol=1e-9)
        assert all(stream[i].stamp_ns <= stream[i + 1].stamp_ns for i in range(len(stream) - 1))


@pytest.mark.parametrize("tf", TF_TYPES)
def test_mounting_and_wheels_are_found_in_transforms_of_either_name(tmp_path: Path, tf: str) -> None:
    with open_recording([write_bag(tmp_path / "a.bag", tf=tf)]) as recording:
        topics = RecordingTopics("/scan", wheels=WheelSource.parse("tf:odom:base_link"))
        mounting = find_mounting(recording, topics)
        assert mounting is not None and mounting.source == "/tf_static" and not mounting.upside_down
        np.testing.assert_allclose(mounting.base_from_scan_xyyaw, [0.2, 0.0, np.pi / 2])
        poses = [each.pose_xyyaw for each in scan_stream(recording, topics) if isinstance(each, WheelPose)]
        np.testing.assert_allclose(poses[-1], [1.9, -0.95, 0.19], atol=1e-9)


@pytest.mark.parametrize("compression", [None, "BZ2"])
def test_a_bag_that_was_cut_off_is_read_to_its_last_whole_record(tmp_path: Path, compression: str | None) -> None:
    path = write_bag(tmp_path / "a.bag", compression=compression)
    with open_recording([path]) as recording:
        whole = [(each.topic, each.log_time_ns) for each in recording.messages()]
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with open_recording([path]) as recording:
        found = [(each.topic, each.log_time_ns) for each in recording.messages()]
        assert recording.unfinished == (path,) and "read record by record" in recording.notes[0]
    assert 5 < len(found) < len(whole) and set(found) <= set(whole)


@pytest.mark.parametrize("padded", [False, True])
def test_index_records_of_2010_that_say_a_wrong_length_do_no_harm(tmp_path: Path, padded: bool) -> None:
    """They say 20 bytes a message, and hold 12."""
    path = write_bag(tmp_path / "a.bag")
    with open_recording([path]) as recording:
        whole = [(each.topic, each.log_time_ns) for each in recording.messages()]
    content = path.read_bytes()
    made, at = content[:13], 13
    while at < len(content):
        head = struct.unpack_from("<I", content, at)[0]
        header = content[at + 4 : at + 4 + head]
        size = struct.unpack_from("<I", content, at + 4 + head)[0]
        data = content[at + 8 + head : at + 8 + head + size]
        if b"op=\x04" in header:
            made += struct.pack("<I", head) + header + struct.pack("<I", size // 12 * 20) + data
            made += bytes(size // 12 * 8) if padded else b""
        else:
            made += content[at : at + 8 + head + size]
        at += 8 + head + size
    path.write_bytes(made)
    with open_recording([path]) as recording:
        assert [(each.topic, each.log_time_ns) for each in recording.messages()] == whole


def test_a_bag_that_was_converted_to_mcap_is_read(tmp_path: Path) -> None:
    """As `mcap convert` writes it."""
    path, messages = tmp_path / "drive.mcap", write_bag(tmp_path / "drive.bag")
    with Reader(messages) as bag, path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros1")
        channels = {}
        for each in bag.connections:
            name = each.msgtype.replace("/msg/", "/")
            schema = writer.register_schema(name, "ros1msg", each.msgdef.data.encode())
            channels[each.id] = writer.register_channel(each.topic, "ros1", schema)
        for each, time_ns, data in bag.messages():
            writer.add_message(channels[each.id], time_ns, data, time_ns)
        writer.finish()
    with open_recording([path]) as found, open_recording([messages]) as right:
        assert found.topics == right.topics and found.notes == ()
        assert [repr(each) for each in found.messages()] == [repr(each) for each in right.messages()]


def test_format_1_2_is_read(tmp_path: Path) -> None:
    """Messages beside their definitions, which name the header as packages did then."""
    text = "Header header\nfloat32 x\n" + "=" * 80 + "\nMSG: roslib/Header\nuint32 seq\ntime stamp\nstring frame_id\n"

    def record(data: bytes, **fields: bytes) -> bytes:
        parts = [name.encode() + b"=" + value for name, value in fields.items()]
        head = b"".join(struct.pack("<I", len(part)) + part for part in parts)
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data

    content = b"#ROSRECORD V1.2\n"
    named = {"topic": b"/old", "md5": b"*", "type": b"pkg/Old"}
    content += record(b"", op=b"\x01", **named, **{"def": text.encode()})
    for k in range(3):
        data = struct.pack("<III", k, 100 + k, 5) + struct.pack("<I", 4) + b"base" + struct.pack("<f", 0.5 * k)
        content += record(data, op=b"\x02", **named, sec=struct.pack("<I", 100 + k), nsec=struct.pack("<I", 5))
    path = tmp_path / "old.bag"
    path.write_bytes(content)
    with open_recording([path]) as recording:
        found = list(recording.messages())
    assert [(each.log_time_ns, each.value.x) for each in found] == [((100 + k) * S + 5, 0.5 * k) for k in range(3)]
    assert found[1].value.header.frame_id == "base" and found[1].value.header.stamp.sec == 101


def test_a_chunk_that_unpacks_to_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = bz2.compress(bytes(300 * 2**20))
    monkeypatch.setattr("rosbags.rosbag1.writer.bz2_compress", lambda data, level: bomb)
    path = write_bag(tmp_path / "a.bag", compression="BZ2")
    with (
        open_recording([path], max_chunk_bytes=10 * 2**20) as recording,
        pytest.raises(RecordingError, match=r"a\.bag is damaged \(a chunk holds more than 10485760 bytes"),
    ):
        list(recording.messages())
    with pytest.raises(RecordingError, match=r"a chunk at byte \d+ declares \d+ bytes; expected at most 100"):
        open_recording([path], max_chunk_bytes=100)
