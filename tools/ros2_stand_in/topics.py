"""`ros2 topic list`, `echo` and `hz`."""

import collections
import math
import time
from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.validate_full_topic_name import validate_full_topic_name

from ros2_stand_in.errors import CommandError
from ros2_stand_in.graph import command_node, is_hidden, poll, settle, spin_while
from ros2_stand_in.message_text import echo_text, message_class

ECHO_DEPTH = 10
REPORT_PERIOD_NS = 1_000_000_000


def print_list(show_types: bool) -> int:
    """`ros2 topic list [-t]`."""
    with command_node() as node:
        topics = settle(node, lambda: sorted((name, tuple(types)) for name, types in node.get_topic_names_and_types()))
    for name, types in topics:
        if not is_hidden(name):
            print(f"{name} [{', '.join(types)}]" if show_types else name)
    return 0


def full_topic_name(node: Node, topic: str) -> str:
    """The topic's absolute name."""
    try:
        name: str = expand_topic_name(topic, node.get_name(), node.get_namespace())
        validate_full_topic_name(name)
    except (ValueError, InvalidTopicNameException) as error:
        raise CommandError(str(error).strip()) from None
    return name


def published_type(node: Node, topic: str) -> str | None:
    """The type of the messages on a topic, or None for a topic without publishers and subscribers."""
    types = dict(node.get_topic_names_and_types()).get(topic)
    if types is None:
        return None
    if len(types) > 1:
        raise CommandError(f"Cannot echo topic '{topic}', as it contains more than one type: [{', '.join(types)}]")
    return str(types[0])


def matching_qos(node: Node, topic: str) -> QoSProfile:
    """A profile that every present publisher of the topic can serve, as strict as they all are."""
    offered = [publisher.qos_profile for publisher in node.get_publishers_info_by_topic(topic)]
    reliable = [qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered]
    latched = [qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered]
    for flags, name, fallback in (
        (reliable, "QoSReliabilityPolicy.RELIABLE", "QoSReliabilityPolicy.BEST_EFFORT"),
        (latched, "QoSDurabilityPolicy.TRANSIENT_LOCAL", "QoSDurabilityPolicy.VOLATILE"),
    ):
        if any(flags) and not all(flags):
            print(
                f"Some, but not all, publishers are offering {name}. Falling back to {fallback} "
                "as it will connect to all publishers"
            )
    every_reliable, every_latched = (bool(flags) and all(flags) for flags in (reliable, latched))
    return QoSProfile(
        depth=ECHO_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if every_reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if every_latched else DurabilityPolicy.VOLATILE,
    )


def echo(topic: str, type_name: str | None, once: bool, field: str | None, truncate_length: int | None) -> int:
    """`ros2 topic echo TOPIC [TYPE]`."""
    with command_node() as node:
        name = full_topic_name(node, topic)
        found = poll(lambda: published_type(node, name)) if type_name is None else type_name
        if found is None:
            print(f"WARNING: topic [{topic}] does not appear to be published yet")
            raise CommandError(
                "Could not determine the type for the passed topic: if its node is starting, wait for its line 'ready'"
            )
        kind = message_class(found)
        if type_name is not None:
            # The profile follows the publishers that are there; with a type given none has been waited for.
            poll(lambda: node.count_publishers(name) or None, timeout_s=1.0)
        done = False

        def show(message: Any) -> None:
            nonlocal done
            if not (done and once):
                print(echo_text(message, field, truncate_length), flush=True)
            done = True

        node.create_subscription(kind, name, show, matching_qos(node, name))
        spin_while(node, lambda: not (done and once))
    return 0


class RateWindow:
    """Times between the last messages of a topic, and the report on them that the real command prints."""

    def __init__(self, window: int) -> None:
        self._intervals_ns: collections.deque[int] = collections.deque(maxlen=window)
        self._last_ns: int | None = None
        self._reported_ns: int | None = None

    def add(self, now_ns: int) -> None:
        """Count a message that was received at this time."""
        if self._last_ns is not None:
            self._intervals_ns.append(now_ns - self._last_ns)
        self._last_ns = now_ns

    def report(self) -> str | None:
        """The report, at most once a second and only after new messages; else None."""
        if not self._intervals_ns or self._last_ns is None:
            return None
        if self._reported_ns is None:
            self._reported_ns = self._last_ns
        if self._last_ns < self._reported_ns + REPORT_PERIOD_NS:
            return None
        self._reported_ns = self._last_ns
        count = len(self._intervals_ns)
        mean = sum(self._intervals_ns) / count
        deviation = math.sqrt(sum((interval - mean) ** 2 for interval in self._intervals_ns) / count)
        rate = 1e9 / mean if mean > 0 else 0.0
        return (
            f"average rate: {rate:.3f}\n"
            f"\tmin: {min(self._intervals_ns) * 1e-9:.3f}s max: {max(self._intervals_ns) * 1e-9:.3f}s "
            f"std dev: {deviation * 1e-9:.5f}s window: {count}"
        )


def hz(topic: str, window: int) -> int:
    """`ros2 topic hz TOPIC`."""
    with command_node() as node:
        name = full_topic_name(node, topic)
        found = poll(lambda: published_type(node, name))
        if found is None:
            print(f"WARNING: topic [{topic}] does not appear to be published yet", flush=True)
            found = poll(lambda: published_type(node, name), timeout_s=math.inf)
        if found is None:  # told to end before anybody published
            return 0
        rate = RateWindow(window)
        # Only the arrival counts, so the message is not converted (raw).
        node.create_subscription(
            message_class(found), name, lambda _: rate.add(time.time_ns()), matching_qos(node, name), raw=True
        )

        def show() -> bool:
            report = rate.report()
            if report is not None:
                print(report, flush=True)
            return True

        spin_while(node, show)
    return 0
