"""The command's own hidden node, and its view of the graph."""

import contextlib
import importlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, TypeVar

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ros2_stand_in.cli import CommandError

# The real command asks a daemon that knows the graph already; here every call discovers it anew.
DISCOVERY_TIMEOUT_S = 5.0
WAIT_S = 0.1

# Participants answer a newcomer at once, but where an answer comes late or is lost (a busy machine) they announce
# themselves every 3 s: what is seen before that may lack some of them.
LIST_LEAST_S = 3.5

Found = TypeVar("Found")

_received: list[int] = []
"""Signals that have told the command to end.

rclpy's own handlers shut down from another thread while the main one is about to wait, which now and then ends in a
traceback or worse; so they are switched off, every wait is short, and the loops look here.
"""


def _note(number: int, _frame: FrameType | None) -> None:
    _received.append(number)


@contextlib.contextmanager
def command_node() -> Iterator[Node]:
    """A node of the same hidden name as the real command's; raises KeyboardInterrupt after it if there was a SIGINT."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _note)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"_ros2cli_{os.getpid()}", start_parameter_services=False)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown()
    if signal.SIGINT in _received:
        raise KeyboardInterrupt


def spin_while(node: Node, condition: Callable[[], bool]) -> None:
    """Take messages while the condition holds and nothing has told the command to end."""
    while not _received and condition():
        rclpy.spin_once(node, timeout_sec=WAIT_S)


def settle(node: Node) -> None:
    """Give every node the time to appear."""
    end = time.monotonic() + LIST_LEAST_S
    spin_while(node, lambda: time.monotonic() < end)


def node_names(node: Node) -> list[str]:
    """Full names of the nodes that are seen now, sorted."""
    return sorted(f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces())


def is_hidden(name: str) -> bool:
    """Whether a name in the graph has a part that starts with an underscore."""
    return any(part.startswith("_") for part in name.split("/"))


def poll(find: Callable[[], Found | None], timeout_s: float = DISCOVERY_TIMEOUT_S) -> Found | None:
    """The first result of `find` that is not None, or None after the timeout."""
    deadline = time.monotonic() + timeout_s
    while (found := find()) is None and time.monotonic() < deadline and not _received:
        time.sleep(0.05)
    return found


def interface(type_name: str, kind: str) -> Any:
    """The class of `package/KIND/Name`, where KIND is msg or srv; CommandError where it cannot be found."""
    package, *middle, name = type_name.split("/") if "/" in type_name else ("", type_name)
    try:
        if middle != [kind] or not package:
            raise ImportError
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError):
        what = "message" if kind == "msg" else "service"
        raise CommandError(f"The passed {what} type is invalid") from None


def call(node: Node, service_type: Any, service: str, request: Any, timeout_s: float = DISCOVERY_TIMEOUT_S) -> Any:
    """A service's response; CommandError where it does not come up or does not answer."""
    client = node.create_client(service_type, service)
    if poll(lambda: client.service_is_ready() or None) is None:
        raise CommandError("Node not found")
    future = client.call_async(request)
    deadline = time.monotonic() + timeout_s
    spin_while(node, lambda: not future.done() and time.monotonic() < deadline)
    if not future.done() or future.result() is None:
        raise CommandError(f"Service '{service}' did not answer")
    return future.result()
