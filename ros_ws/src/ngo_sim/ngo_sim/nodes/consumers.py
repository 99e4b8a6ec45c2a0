"""The nodes that process a simulator's frames, known by the stamps on the topics that they publish."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence

from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.subscription import Subscription

from ngo_sim.flow_control import FlowControl, header_stamp_ns


class Consumers:
    """Feeds a FlowControl from topics of any stamped type. Call look() regularly, because consumers come and go.

    Messages are never deserialised: the stamp is read from the bytes of the header.
    """

    def __init__(self, node: Node, topics: Sequence[str], flow: FlowControl) -> None:
        self._node = node
        self._topics = tuple(topics)
        self._flow = flow
        self._subscriptions: dict[str, Subscription] = {}
        self._unstamped: set[str] = set()
        self._progress_s = 0.0
        self._answers = 0

    def look(self) -> None:
        """Find which topics have a publisher now, and listen to them."""
        present = set()
        for topic in self._topics:
            publishers = self._node.get_publishers_info_by_topic(topic)
            if not publishers or topic in self._unstamped:
                continue
            if topic not in self._subscriptions and not self._listen(
                topic, publishers[0].topic_type, publishers[0].qos_profile.reliability
            ):
                continue
            present.add(topic)
        self._flow.set_topics(present)

    def complete(self) -> bool:
        """Whether every topic has a publisher."""
        return self._flow.topics | self._unstamped >= set(self._topics)

    def published(self, stamp_ns: int, now_s: float) -> None:
        """A frame with this stamp was published."""
        self._flow.published(stamp_ns)
        self._progress_s = now_s

    def may_publish(self, now_s: float, stall_timeout_s: float) -> bool:
        """Whether the slowest consumer is ready for one more frame."""
        return self._flow.may_publish() or self._stalled(now_s, stall_timeout_s)

    def drained(self, now_s: float, stall_timeout_s: float) -> bool:
        """Whether every consumer has finished all frames."""
        return self._flow.in_flight() == 0 or self._stalled(now_s, stall_timeout_s)

    def _stalled(self, now_s: float, stall_timeout_s: float) -> bool:
        """Whether the timeout has passed without an answer; if so, warn and count the frames in flight as lost."""
        if self._answers:
            self._answers, self._progress_s = 0, now_s
        if stall_timeout_s == 0.0 or now_s - self._progress_s < stall_timeout_s:
            return False
        self._node.get_logger().warning(
            f"no answer on {', '.join(self._flow.waiting_for())} for {stall_timeout_s:g} s: "
            f"counting {self._flow.in_flight()} frames as lost and going on"
        )
        self._flow.give_up()
        return True

    def _listen(self, topic: str, type_name: str, reliability: QoSReliabilityPolicy) -> bool:
        package, _, name = type_name.split("/")
        try:
            message_type = getattr(importlib.import_module(f"{package}.msg"), name)
            first_field = next(iter(message_type.get_fields_and_field_types().values()))
        except (ImportError, AttributeError, StopIteration):
            first_field = None
        if first_field != "std_msgs/Header":
            self._unstamped.add(topic)
            self._node.get_logger().warning(
                f"{topic} of type {type_name} has no stamp that can be read: it takes no part in flow control"
            )
            return False
        self._subscriptions[topic] = self._node.create_subscription(
            message_type, topic, self._heard(topic), QoSProfile(depth=100, reliability=reliability), raw=True
        )
        return True

    def _heard(self, topic: str) -> Callable[[bytes], None]:
        def heard(cdr: bytes) -> None:
            self._answers += 1
            self._flow.seen(topic, header_stamp_ns(cdr))

        return heard
