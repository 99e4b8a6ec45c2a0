"""Records everything that a graph publishes into one MCAP file, byte by byte as it came over DDS."""

from __future__ import annotations

import importlib
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import rclpy
from ament_index_python.packages import get_package_share_directory
from mcap.writer import CompressionType, Writer
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from ngo_sim.flow_control import header_stamp_ns

# Every topic of the graph; the image last, because the simulator waits for its subscribers: by then all others are
# matched.
ALL_TOPICS = {
    "action": "ngo_msgs/msg/DiscreteAction",
    "action_command": "ngo_msgs/msg/DiscreteAction",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "scan": "sensor_msgs/msg/LaserScan",
    "ground_truth": "nav_msgs/msg/Odometry",
    "relative_pose": "ngo_msgs/msg/RelativePose",
    "odom": "nav_msgs/msg/Odometry",
    "ngo/path": "nav_msgs/msg/Path",
    "ngo/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "ngo/trajectory": "ngo_msgs/msg/Trajectory",
    "ngo/loops": "visualization_msgs/msg/MarkerArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/clock": "rosgraph_msgs/msg/Clock",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/rosout": "rcl_interfaces/msg/Log",
    "image": "sensor_msgs/msg/Image",
}
_FLUSH_S = 1.0

Listener = Callable[[bytes, int, int], None]
"""Called with the serialised message, and when it was published and received (wall clock, ns)."""


class Recorder:
    """Subscribes topics and writes every message to a file; readable up to its last second when the process is killed.

    Log time is when a message was received here, publish time when its writer published it, both of the wall clock.
    """

    def __init__(
        self, path: Path, domain_id: int, topics: Mapping[str, str] = ALL_TOPICS, chunk_bytes: int = 2**20
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="ngo demo")
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain_id)
        self._node = rclpy.create_node("recorder", context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._listeners: dict[str, Listener] = {}
        self.counts: dict[str, int] = dict.fromkeys(topics, 0)
        self._flushed_s = time.monotonic()
        for topic, type_name in topics.items():
            self._subscribe(topic, type_name)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def listen(self, topic: str, listener: Listener) -> None:
        """Call listener with every message of a recorded topic, too."""
        self._listeners[topic] = listener

    def has_publisher(self, topic: str) -> bool:
        """Whether somebody publishes the topic."""
        return self._node.count_publishers(topic) > 0

    def has_subscriber(self, topic: str, besides: int = 1) -> bool:
        """Whether somebody subscribes the topic besides this recorder."""
        return self._node.count_subscribers(topic) > besides

    def spin_once(self, timeout_s: float = 0.05) -> None:
        """Take the messages that are there; wait up to timeout_s for one."""
        self._executor.spin_once(timeout_sec=timeout_s)
        now_s = time.monotonic()
        if now_s - self._flushed_s > _FLUSH_S:
            self._flushed_s = now_s
            self._writer.flush()  # type: ignore[no-untyped-call]

    def _subscribe(self, topic: str, type_name: str) -> None:
        package, _, name = type_name.split("/")
        message_type = getattr(importlib.import_module(f"{package}.msg"), name)
        schema_id = self._writer.register_schema(type_name, "ros2msg", message_definition(type_name).encode())
        channel_id = self._writer.register_channel(self._node.resolve_topic_name(topic), "cdr", schema_id)
        # Reliable and without a limit: what the writer kept, this reader gets and keeps until it is written.
        qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=0, reliability=ReliabilityPolicy.RELIABLE)

        def received(cdr: bytes, info: dict[str, Any]) -> None:
            published_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
            self._writer.add_message(channel_id, log_time=received_ns, data=cdr, publish_time=published_ns)
            self.counts[topic] += 1
            if topic in self._listeners:
                self._listeners[topic](cdr, published_ns, received_ns)

        self._node.create_subscription(message_type, topic, received, qos, raw=True)


class StampTimes:
    """Remembers for each header stamp of a topic when its message was published and received: a listener."""

    def __init__(self) -> None:
        self.published_ns: dict[int, int] = {}
        self.received_ns: dict[int, int] = {}
        self.newest_ns = -1

    def __call__(self, cdr: bytes, published_ns: int, received_ns: int) -> None:
        self.newest_ns = header_stamp_ns(cdr)
        self.published_ns[self.newest_ns] = published_ns
        self.received_ns[self.newest_ns] = received_ns


def message_definition(type_name: str) -> str:
    """The text of a message type and of all it is made of, as MCAP wants it for schema encoding ros2msg."""
    texts: dict[str, str] = {}
    waiting = deque([type_name])
    while waiting:
        package, _, name = waiting.popleft().split("/")
        if f"{package}/{name}" in texts:
            continue
        text = Path(get_package_share_directory(package), "msg", f"{name}.msg").read_text()
        texts[f"{package}/{name}"] = text
        waiting += [f"{owner or package}/msg/{part}" for owner, part in _compound_fields(text)]
    (_, first), *others = texts.items()
    return first + "".join(f"\n{'=' * 80}\nMSG: {name}\n{text}" for name, text in others)


def _compound_fields(text: str) -> Iterator[tuple[str, str]]:
    """Package (empty: the message's own) and name of every field type that begins with a capital: a message."""
    for match in re.finditer(r"^\s*(?:(\w+)/)?([A-Z]\w*)[^\s=]*\s+\w+", text, re.MULTILINE):
        yield match.group(1) or "", match.group(2)
