"""The command's own hidden node, and its view of the graph."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, TypeVar

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ros2_stand_in.errors import CommandError

# The real command asks a daemon that knows the graph already; here every call discovers it anew.
DISCOVERY_TIMEOUT_S = 5.0
WAIT_S = 0.1
LIST_STABLE_S = 0.5
# Participants answer a newcomer at once, but where an answer comes late or is lost (a busy machine) they announce
# themselves every 3 s: what is seen before that may lack some of them.
LIST_LEAST_S = 3.5

Found = TypeVar("Found")


class _Signals:
    """Notes SIGINT and SIGTERM instead of raising at once.

    rclpy's own handlers shut down from another thread while the main one is about to wait, which now and then ends in a
    traceback or worse; so they are switched off, every wait is short, and the loops look here.
    """

    def __init__(self) -> None:
        self.received: int | None = None

    def install(self) -> None:
        """Handle both signals from now on."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.received = number


_signals = _Signals()


def running() -> bool:
    """Whether no signal has told the command to end."""
    return _signals.received is None


@contextlib.contextmanager
def command_node() -> Iterator[Node]:
    """A node of the same hidden name as the real command's; raises KeyboardInterrupt after it if there was a SIGINT."""
    _signals.install()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"_ros2cli_{os.getpid()}", start_parameter_services=False)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown()
    if _signals.received == signal.SIGINT:
        raise KeyboardInterrupt


def spin_while(node: Node, condition: Callable[[], bool]) -> None:
    """Take messages while the condition holds and nothing has told the command to end."""
    while running() and condition():
        rclpy.spin_once(node, timeout_sec=WAIT_S)


def poll(find: Callable[[], Found | None], timeout_s: float = DISCOVERY_TIMEOUT_S) -> Found | None:
    """The first result of `find` that is not None, or None after the timeout."""
    deadline = time.monotonic() + timeout_s
    while (found := find()) is None and time.monotonic() < deadline and running():
        time.sleep(0.05)
    return found


def settle(node: Node, look: Callable[[], Found]) -> Found:
    """The result of `look` once every node has had time to appear and nothing changes any more."""
    start = changed = time.monotonic()
    seen = look()
    while running() and (now := time.monotonic()) - start < DISCOVERY_TIMEOUT_S:
        if now - start > LIST_LEAST_S and now - changed > LIST_STABLE_S:
            break
        time.sleep(WAIT_S)
        current = look()
        if current != seen:
            seen, changed = current, time.monotonic()
    return seen


def is_hidden(name: str) -> bool:
    """Whether a node's or topic's name has a part that starts with an underscore."""
    return any(part.startswith("_") for part in name.split("/"))


def full_name(name: str, namespace: str) -> str:
    """`/namespace/name`."""
    return f"{namespace.rstrip('/')}/{name}"


def absolute(node_name: str) -> str:
    """A node's name as it stands in the graph."""
    return node_name if node_name.startswith("/") else f"/{node_name}"


def node_names(node: Node, include_hidden: bool = False) -> list[str]:
    """Full names of the nodes that are seen now, sorted."""
    names = sorted(full_name(name, namespace) for name, namespace in node.get_node_names_and_namespaces())
    return [name for name in names if include_hidden or not is_hidden(name)]


def require_node(node: Node, node_name: str) -> str:
    """The full name of a node, waiting a while for it to be seen."""
    name = absolute(node_name)
    if poll(lambda: name if name in node_names(node, include_hidden=True) else None) is None:
        raise CommandError("Node not found")
    return name


def print_nodes(include_hidden: bool) -> int:
    """`ros2 node list`."""
    with command_node() as node:
        names = settle(node, lambda: node_names(node, include_hidden))
    if len(set(names)) < len(names):
        print(
            "WARNING: Be aware that there are nodes in the graph that share an exact name, "
            "which can have unintended side effects.",
            file=sys.stderr,
        )
    for name in names:
        print(name)
    return 0


def call(node: Node, service_type: Any, service: str, request: Any, timeout_s: float = DISCOVERY_TIMEOUT_S) -> Any:
    """A service's response; CommandError where the service does not come up or does not answer."""
    client = node.create_client(service_type, service)
    if poll(lambda: client.service_is_ready() or None) is None:
        raise CommandError("Wait for service timed out")
    future = client.call_async(request)
    deadline = time.monotonic() + timeout_s
    spin_while(node, lambda: not future.done() and time.monotonic() < deadline)
    if not future.done():
        raise CommandError(f"Service '{service}' did not answer")
    if future.result() is None:
        raise CommandError(f"Exception while calling service '{service}': {future.exception()}")
    return future.result()
