"""A node that fell behind takes several messages in one turn of the executor, in their order, and at most so many."""

import time
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Header

from demo.graph import free_domain_id
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.settings import NgoNodeSettings
from ngo_estimator.nodes.status import NodeStatus

_TIMEOUT_S = 30.0


@pytest.fixture
def node() -> Iterator[Node]:
    context = Context()
    rclpy.init(args=[], context=context, domain_id=free_domain_id())
    made = rclpy.create_node("listening", context=context)
    yield made
    made.destroy_node()
    rclpy.try_shutdown(context=context)


@pytest.mark.parametrize(("at_once", "expected"), [(1, [1, 1, 1, 1, 1, 1]), (4, [4, 2])])
def test_messages_that_wait_are_taken_together(node: Node, at_once: int, expected: list[int]) -> None:
    taken: list[int] = []
    status = NodeStatus(node, NgoNodeSettings(diagnostics_period_s=60.0), dict)
    listening = Listening(node, status, 10.0)
    listening.to(Header, "header", lambda message: taken.append(message.stamp.sec), QoSProfile(depth=10), None, at_once)
    publisher = node.create_publisher(Header, "header", 10)
    deadline_s = time.monotonic() + _TIMEOUT_S
    while publisher.get_subscription_count() == 0 and time.monotonic() < deadline_s:
        time.sleep(0.01)
    for number in range(6):
        message = Header()
        message.stamp.sec = number
        publisher.publish(message)
    assert publisher.wait_for_all_acked(Duration(seconds=_TIMEOUT_S))  # they wait in the subscription now
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    turns = [0]
    while turns[-1] < 6 and time.monotonic() < deadline_s:
        executor.spin_once(timeout_sec=1.0)
        turns.append(len(taken))
    assert taken == list(range(6))
    assert [after - before for before, after in zip(turns, turns[1:], strict=False) if after > before] == expected
