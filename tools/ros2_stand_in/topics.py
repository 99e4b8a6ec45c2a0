"""`ros2 topic list`, `echo`, which prints messages as YAML, and `hz`; lists of nodes and services."""

import array
import collections
import math
import sys
import time
from typing import Any

import numpy as np
import yaml
from rclpy.exceptions import InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.validate_full_topic_name import validate_full_topic_name

from ros2_stand_in.cli import CommandError
from ros2_stand_in.graph import command_node, interface, is_hidden, node_names, poll, settle, spin_while

ECHO_DEPTH = 10
TRUNCATE_LENGTH = 128
REPORT_PERIOD_NS = 1_000_000_000


def plain(value: Any, truncate_length: int | None) -> Any:
    """A field's value in Python's own types, in the order of the .msg file.

    Strings, bytes and arrays longer than `truncate_length` end there with '...'; None keeps them whole.
    """
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name), truncate_length) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    if isinstance(value, (str, list, tuple, array.array, np.ndarray)):
        too_long = truncate_length is not None and len(value) > truncate_length
        if isinstance(value, str):
            return value[:truncate_length] + "..." if too_long else value
        return [*(plain(item, truncate_length) for item in value[:truncate_length]), *(["..."] if too_long else [])]
    return value.item() if isinstance(value, np.generic) else value


def echo_text(message: Any, field: str | None = None, truncate_length: int | None = None) -> str:
    """The output of `ros2 topic echo` for one message, or the part that a dotted path names, with the separator."""
    for name in field.split(".") if field else ():
        try:
            message = getattr(message, name)
        except AttributeError as error:
            raise CommandError(f"Invalid field '{field}': {error}") from None
    if not hasattr(message, "get_fields_and_field_types"):
        return f"{message}\n---"
    text: str = yaml.dump(
        plain(message, truncate_length),
        sort_keys=False,
        allow_unicode=True,
        width=sys.maxsize,
        default_flow_style=False,
    )
    return text + "---"


def print_list(kind: str, show_types: bool = False, include_hidden: bool = False) -> int:
    """`ros2 topic list [-t]`, `ros2 service list` and `ros2 node list [-a]`."""
    with command_node() as node:
        settle(node)
        found = [(name, [""]) for name in node_names(node)]
        if kind != "node":
            found = node.get_topic_names_and_types() if kind == "topic" else node.get_service_names_and_types()
    for name, types in sorted(found):
        if include_hidden or not is_hidden(name):
            print(f"{name} [{', '.join(types)}]" if show_types else name)
    return 0


def published_type(node: Node, topic: str) -> str | None:
    """The type of the messages on a topic, or None for a topic without publishers and subscribers."""
    types = dict(node.get_topic_names_and_types()).get(topic)
    if types is not None and len(types) > 1:
        raise CommandError(f"Cannot echo topic '{topic}', as it contains more than one type: [{', '.join(types)}]")
    return None if types is None else str(types[0])


def matching_qos(node: Node, topic: str) -> QoSProfile:
    """A profile that every present publisher of the topic can serve, as strict as they all are."""
    offered = [publisher.qos_profile for publisher in node.get_publishers_info_by_topic(topic)]
    reliable = offered and all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = offered and all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        depth=ECHO_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def full_name(node: Node, topic: str) -> str:
    """The topic's absolute name."""
    try:
        name: str = expand_topic_name(topic, node.get_name(), node.get_namespace())
        validate_full_topic_name(name)
    except (ValueError, InvalidTopicNameException) as error:
        raise CommandError(str(error).strip()) from None
    return name


def echo(topic: str, type_name: str | None, once: bool, field: str | None, full_length: bool) -> int:
    """`ros2 topic echo TOPIC [TYPE]`."""
    with command_node() as node:
        name = full_name(node, topic)
        found = poll(lambda: published_type(node, name)) if type_name is None else type_name
        if found is None:
            print(f"WARNING: topic [{topic}] does not appear to be published yet")
            raise CommandError(
                "Could not determine the type for the passed topic: if its node is starting, wait for its line 'ready'"
            )
        kind = interface(found, "msg")
        if type_name is not None:
            # The profile follows the publishers that are there; with a type given none has been waited for.
            poll(lambda: node.count_publishers(name) or None, timeout_s=1.0)
        shown = 0

        def show(message: Any) -> None:
            nonlocal shown
            if not (shown and once):
                print(echo_text(message, field, None if full_length else TRUNCATE_LENGTH), flush=True)
            shown += 1

        node.create_subscription(kind, name, show, matching_qos(node, name))
        spin_while(node, lambda: not (shown and once))
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
        seconds = 1e-9 * np.array(self._intervals_ns)
        rate = 1.0 / seconds.mean() if seconds.any() else 0.0
        return (
            f"average rate: {rate:.3f}\n\tmin: {seconds.min():.3f}s max: {seconds.max():.3f}s "
            f"std dev: {seconds.std():.5f}s window: {len(seconds)}"
        )


def hz(topic: str, window: int) -> int:
    """`ros2 topic hz TOPIC`."""
    if window < 1:
        raise CommandError("value must be a positive integer")
    with command_node() as node:
        name = full_name(node, topic)
        found = poll(lambda: published_type(node, name))
        if found is None:
            print(f"WARNING: topic [{topic}] does not appear to be published yet", flush=True)
            found = poll(lambda: published_type(node, name), timeout_s=math.inf)
        if found is None:  # told to end before anybody published
            return 0
        rate, kind = RateWindow(window), interface(found, "msg")
        # Only the arrival counts, so the message is not converted (raw).
        node.create_subscription(kind, name, lambda _: rate.add(time.time_ns()), matching_qos(node, name), raw=True)

        def show() -> bool:
            if (report := rate.report()) is not None:
                print(report, flush=True)
            return True

        spin_while(node, show)
    return 0
