"""The command's own hidden node, and what it finds in the graph."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from ros2_stand_in.errors import CommandError

# The real command asks a daemon that knows the graph already; here every call discovers it anew.
DISCOVERY_TIMEOUT_S = 5.0
LIST_STABLE_S = 0.5
# Participants answer a newcomer at once, but where an answer comes late or is lost (a busy machine) they announce
# themselves every 3 s: what is seen before that may lack some of them.
LIST_LEAST_S = 3.5

Found = TypeVar("Found")


@contextlib.contextmanager
def command_node() -> Iterator[Node]:
    """A node of the same hidden name as the real command's; ends quietly when the process is told to end."""
    rclpy.init(args=[])
    try:
        node = rclpy.create_node(f"_ros2cli_{os.getpid()}", start_parameter_services=False)
        yield node
    except ExternalShutdownException:
        pass
    except Exception:
        # A signal may shut down between a look at rclpy.ok() and the next call, which then fails in whatever way.
        if rclpy.ok():
            raise
    finally:
        rclpy.try_shutdown()


def poll(find: Callable[[], Found | None], timeout_s: float = DISCOVERY_TIMEOUT_S) -> Found | None:
    """The first result of `find` that is not None, or None after the timeout."""
    deadline = time.monotonic() + timeout_s
    while (found := find()) is None and time.monotonic() < deadline and rclpy.ok():
        time.sleep(0.05)
    return found


def settle(node: Node, look: Callable[[], Found]) -> Found:
    """What `look` sees once every node has had time to show itself and nothing changes any more."""
    start = changed = time.monotonic()
    seen = look()
    while rclpy.ok() and (now := time.monotonic()) - start < DISCOVERY_TIMEOUT_S:
        if now - start > LIST_LEAST_S and now - changed > LIST_STABLE_S:
            break
        time.sleep(0.1)
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
    names: list[str] = []
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


def call(node: Node, service_type: Any, service: str, request: Any) -> Any:
    """A service's response; CommandError where the service does not come up or does not answer."""
    client = node.create_client(service_type, service)
    if not client.wait_for_service(timeout_sec=DISCOVERY_TIMEOUT_S):
        raise CommandError("Wait for service timed out")
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future, timeout_sec=DISCOVERY_TIMEOUT_S)
    if future.result() is None:
        raise CommandError(f"Exception while calling service '{service}': {future.exception() or 'no answer'}")
    return future.result()
