"""A recorder of topics of a running graph into one MCAP file, byte for byte as they came over DDS."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from ngo_common.waiting import waiting_messages
from ngo_recordings.errors import RecordingError
from ngo_recordings.writer import RecordingWriter

_BUNCH_S = 0.02  # Messages of so long are taken together.
_MOST = 100  # Messages of one topic that are taken together.

Listener = Callable[[bytes, int, int], None]
"""Called with the serialised message, and when it was published and received (wall clock, ns)."""


class Recorder:
    """Subscribes topics and writes every message to a file; readable up to its last second when the process is killed.

    Log time is when a message was received here, publish time when its writer published it, both of the wall clock.
    topics: types by name, subscribed at once. path: a .mcap file, or a new folder for rosbag2's layout.
    """

    def __init__(
        self,
        path: Path,
        domain_id: int | None = None,
        topics: Mapping[str, str] | None = None,
        chunk_bytes: int = 2**20,
    ) -> None:
        self.writer = RecordingWriter(path, chunk_bytes=chunk_bytes, library="ngo recorder")
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain_id)
        self.node = rclpy.create_node("recorder", context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._topics: list[tuple[Subscription, Callable[[bytes, dict[str, Any]], None]]] = []
        self._taken_s = 0.0
        self._listeners: dict[str, Listener] = {}
        self.counts: dict[str, int] = {}
        for topic, type_name in (topics or {}).items():
            self.subscribe(topic, type_name)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.writer.close()
        finally:
            self._executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self._context)

    def listen(self, topic: str, listener: Listener) -> None:
        """Call listener with every message of a recorded topic, too."""
        self._listeners[topic] = listener

    def has_publisher(self, topic: str) -> bool:
        """Whether somebody publishes the topic."""
        return self.node.count_publishers(topic) > 0

    def has_subscriber(self, topic: str, besides: int = 1) -> bool:
        """Whether somebody subscribes the topic besides this recorder."""
        return self.node.count_subscribers(topic) > besides

    def spin_once(self, timeout_s: float = 0.05) -> None:
        """Take the messages that are there; wait up to timeout_s for one.

        A turn of the executor costs as much as many messages, so they are taken in bunches.
        """
        time.sleep(max(0.0, self._taken_s + min(timeout_s, _BUNCH_S) - time.monotonic()))
        self._executor.spin_once(timeout_sec=timeout_s)
        self._taken_s = time.monotonic()
        bunch = [
            (info["received_timestamp"], received, cdr, info)
            for subscription, received in self._topics
            for cdr, info in waiting_messages(subscription, _MOST)
        ]
        for _, received, cdr, info in sorted(bunch, key=itemgetter(0)):
            received(cdr, info)
        self.writer.flush_if_due()

    def subscribe(self, topic: str, type_name: str, reliable: bool = True, transient_local: bool = False) -> None:
        """Record a topic from now on; best effort gets messages of every publisher, but may lose some.

        Raises RecordingError where no ROS package here has the type.
        """
        package, _, name = type_name.split("/")
        try:
            message_type = getattr(importlib.import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError):
            raise RecordingError(
                f"topic {topic} is {type_name}, which no package here has: open the workspace that has it"
            ) from None
        resolved = self.node.resolve_topic_name(topic)
        self.writer.add_topic(resolved, type_name, reliable=reliable, transient_local=transient_local)
        self.counts[topic] = 0
        # Without a limit: what the publisher kept, this reader gets and keeps until it is written.
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_ALL,
            depth=0,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if transient_local else DurabilityPolicy.VOLATILE,
        )

        def received(cdr: bytes, info: dict[str, Any]) -> None:
            published_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
            self.writer.write(resolved, cdr, received_ns, published_ns)
            self.counts[topic] += 1
            if topic in self._listeners:
                self._listeners[topic](cdr, published_ns, received_ns)

        self._topics.append((self.node.create_subscription(message_type, topic, received, qos, raw=True), received))
