"""The subscriptions of a node whose messages can't end it, most of them from one publisher a topic."""

import traceback
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile

from ngo_common.nodes.qos import overridable
from ngo_estimator.nodes.inputs import Input
from ngo_estimator.nodes.status import NodeStatus


class Listening:
    """Makes subscriptions, and keeps them."""

    def __init__(self, node: Node, status: NodeStatus, timeout_s: float) -> None:
        self._node, self._status, self._timeout_s = node, status, timeout_s
        self._inputs: list[Input] = []

    def to(
        self,
        message_type: type,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        group: CallbackGroup | None = None,
        at_once: int = 1,
        each_frame: bool = False,
    ) -> Input:
        """Take the messages of one publisher, or of one for each frame; frames, where there are any, tell them apart.

        A node that fell behind takes up to ``at_once`` messages in one turn of the executor.
        """

        take = self._safe(topic, callback)
        made = Input(
            self._node,
            self._status,
            message_type,
            topic,
            qos,
            take,
            _frame_of,
            self._timeout_s,
            group,
            at_once,
            each_frame,
        )
        self._inputs.append(made)
        return made

    def to_all(self, message_type: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> None:
        """Take the messages of all publishers."""
        take = self._safe(topic, callback)
        self._node.create_subscription(message_type, topic, take, qos, qos_overriding_options=overridable())

    def _safe(self, topic: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            try:
                callback(message)
            except Exception as error:
                # A fault of ours, not of the message: a robot is better off with a gap than without the node.
                reason = f"internal error, {type(error).__name__}: {' '.join(str(error).split())}"
                self._status.dropped(f"message on '{topic}'", reason)
                self._node.get_logger().debug(traceback.format_exc())

        return take

    def set_timeout(self, timeout_s: float) -> None:
        """How long a publisher may be silent until another takes its place."""
        for entry in self._inputs:
            entry.set_timeout(timeout_s)

    def problems(self) -> list[str]:
        """A line for each publisher that does not fit."""
        return [line for entry in self._inputs for line in entry.problems()]


def _frame_of(message: Any) -> str:
    return message.header.frame_id if hasattr(message, "header") else ""
