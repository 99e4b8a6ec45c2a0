"""Messages for tests, made and serialised by the rosbags library without ROS, and files of them."""

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Picture
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from ngo_recordings.definitions import message_definition
from ngo_recordings.writer import RecordingWriter

STORE = get_typestore(Stores.ROS2_JAZZY)
ACTION = "ngo_msgs/msg/DiscreteAction"
STORE.register(
    {
        name: fields
        for name, fields in get_types_from_msg(message_definition(ACTION), ACTION).items()
        if name not in STORE.types
    }
)

# Topic, log time (ns), message.
Entry = tuple[str, int, Any]


def make(type_name: str, *args: Any) -> Any:
    return STORE.types[type_name](*args)


def header(stamp_ns: int, frame: str = "base_link") -> Any:
    time = make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
    return make("std_msgs/msg/Header", time, frame)


def image(stamp_ns: int, pixels: np.ndarray, encoding: str = "rgb8", padding: int = 0, big: bool = False) -> Any:
    height, width = pixels.shape[:2]
    rows = np.frombuffer(pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).tobytes(), np.uint8)
    rows = np.pad(rows.reshape(height, -1), ((0, 0), (0, padding)), constant_values=99)
    return make(
        "sensor_msgs/msg/Image", header(stamp_ns), height, width, encoding, int(big), rows.shape[1], rows.ravel()
    )


def compressed(stamp_ns: int, pixels: np.ndarray, kind: str, quality: int = 95) -> Any:
    buffer = io.BytesIO()
    squeezed = pixels[..., 0] if pixels.shape[2] == 1 else pixels
    Picture.fromarray(squeezed).save(buffer, kind, quality=quality)
    data = np.frombuffer(buffer.getvalue(), np.uint8)
    return make("sensor_msgs/msg/CompressedImage", header(stamp_ns), f"rgb8; {kind} compressed", data)


def cloud(
    stamp_ns: int,
    fields: dict[str, np.ndarray],
    frame: str = "lidar",
    height: int = 1,
    padding: int = 0,
    big: bool = False,
) -> Any:
    """A PointCloud2 whose fields ``(points,)`` lie one after the other, with ``padding`` bytes behind each point."""
    codes = {"i2": 3, "f4": 7, "f8": 8, "u2": 4, "u4": 6}
    order = ">" if big else "<"
    kind = np.dtype([(name, order + values.dtype.str[1:]) for name, values in fields.items()] + [("", f"V{padding}")])
    points = np.zeros(len(fields["x"]), kind)
    for name, values in fields.items():
        points[name] = values
    described = [
        make("sensor_msgs/msg/PointField", name, kind.fields[name][1], codes[values.dtype.str[1:]], 1)
        for name, values in fields.items()
    ]
    width, step = len(points) // height, kind.itemsize
    data = np.frombuffer(points.tobytes(), np.uint8)
    values = (height, width, described, big, step, step * width, data, True)
    return make("sensor_msgs/msg/PointCloud2", header(stamp_ns, frame), *values)


def scan(stamp_ns: int, ranges: np.ndarray, angle_min: float = -1.0, increment: float = 0.5, high: float = 10.0) -> Any:
    angle_max = angle_min + (len(ranges) - 1) * increment
    values = (angle_min, angle_max, increment, 0.0, 0.1, 0.05, high)
    return make(
        "sensor_msgs/msg/LaserScan", header(stamp_ns), *values, ranges.astype(np.float32), np.zeros(0, np.float32)
    )


def action(stamp_ns: int, number: int) -> Any:
    values = {"header": header(stamp_ns), "action": number}
    return STORE.types[ACTION](**values)


def vector(x: float, y: float, z: float) -> Any:
    return make("geometry_msgs/msg/Vector3", x, y, z)


def pose(x: float, y: float, yaw: float, z: float = 0.0, roll: float = 0.0, pitch: float = 0.0) -> Any:
    qx, qy, qz, qw = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    return make(
        "geometry_msgs/msg/Pose",
        make("geometry_msgs/msg/Point", x, y, z),
        make("geometry_msgs/msg/Quaternion", qx, qy, qz, qw),
    )


def pose_stamped(stamp_ns: int, *values: float) -> Any:
    return make("geometry_msgs/msg/PoseStamped", header(stamp_ns, "map"), pose(*values))


def twist(forward: float, left: float, turn: float) -> Any:
    return make("geometry_msgs/msg/Twist", vector(forward, left, 0.0), vector(0.0, 0.0, turn))


def odometry(stamp_ns: int, at: Any, speed: Any) -> Any:
    zeros = np.zeros(36)
    return make(
        "nav_msgs/msg/Odometry",
        header(stamp_ns, "map"),
        "base_link",
        make("geometry_msgs/msg/PoseWithCovariance", at, zeros),
        make("geometry_msgs/msg/TwistWithCovariance", speed, zeros),
    )


def transform(stamp_ns: int, parent: str, child: str, at: Any) -> Any:
    moved = make("geometry_msgs/msg/Transform", vector(at.position.x, at.position.y, at.position.z), at.orientation)
    return make("geometry_msgs/msg/TransformStamped", header(stamp_ns, parent), child, moved)


def transforms(*each: Any) -> Any:
    return make("tf2_msgs/msg/TFMessage", list(each))


def serialised(message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def write_mcap(path: Path, entries: Iterable[Entry], **options: Any) -> Path:
    """A file (or folder) by our own writer."""
    with RecordingWriter(path, **options) as writer:
        known: set[str] = set()
        for topic, log_time_ns, message in entries:
            if topic not in known:
                writer.add_topic(topic, message.__msgtype__)
                known.add(topic)
            writer.write(topic, serialised(message), log_time_ns)
    return path


def write_rosbag(
    path: Path,
    entries: Iterable[Entry],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A folder by the rosbags library."""
    bag = Writer(path, version=9, storage_plugin=storage)
    bag.set_compression(compression, CompressionFormat.ZSTD)
    with bag as writer:
        connections: dict[str, Any] = {}
        for topic, log_time_ns, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(connections[topic], log_time_ns, STORE.serialize_cdr(message, message.__msgtype__))
    return path
