"""Subscriptions that check their publishers: one publisher a topic, with a QoS that fits."""

from collections.abc import Callable, Hashable
from typing import Any

from ngo_msgs.msg import RelativePose
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ngo_common.nodes.qos import overridable
from ngo_common.waiting import waiting_messages
from ngo_estimator.frontend.source_guard import SourceGuard
from ngo_estimator.nodes.messages import to_ns
from ngo_estimator.nodes.settings import NgoNodeSettings
from ngo_estimator.nodes.status import NodeStatus

AT_ONCE = 8  # Relative poses that are taken in one turn of the executor where a node fell behind.

# The graph learns of a publisher before it learns its node's name: nothing is said before that.
_UNKNOWN = "a node of a name not known yet"


class OtherPublisher(ValueError):
    """A message of another publisher than the one that is held on to."""


class OnDemand(CallbackGroup):
    """Keeps the executor from waking for messages: they wait for ``Input.take_waiting``.

    The executor must not wait for events of the subscription either: to rmw_fastrtps a message that waits is one, and
    the executor would turn without end.
    """

    def can_execute(self, entity: Any) -> bool:
        """Nothing."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Not what was not allowed."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing was begun."""


class Input:
    """A subscription that takes the messages of the first publisher only, and reports others.

    Messages of other publishers on the same topic are dropped and counted. Publishers with a quality of service that
    does not fit are named, because none of their messages arrive.
    """

    def __init__(
        self,
        node: Node,
        status: NodeStatus,
        message_type: type,
        topic: str,
        qos: QoSProfile | int,
        callback: Callable[[Any], None],
        identity: Callable[[Any], Hashable],
        timeout_s: float,
        group: CallbackGroup | None = None,
        at_once: int = 1,
        each_identity: bool = False,
    ) -> None:
        """Have ``callback`` called with each message; ``identity`` gives the source that a message names.

        A node that fell behind takes up to ``at_once`` messages in one turn of the executor. With ``each_identity`` one
        publisher is held on to for each identity.
        """
        self._node, self._status = node, status
        self._behind = at_once - 1
        self._callback, self._identity = callback, identity
        self._each_identity = each_identity
        self._guards: dict[Hashable, SourceGuard] = {None: SourceGuard(timeout_s)}
        self._kind = f"message on {topic}"
        self._others = ""  # who published beside the one that is held on to, since the last call of problems()
        self._misfit_said = ""
        self._subscription = node.create_subscription(
            message_type,
            topic,
            self._on_message,
            qos,
            callback_group=group,
            # ``problems`` says which publishers do not fit. Each event would cost in every turn of the executor.
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=overridable(),
        )

    def take_waiting(self, most: int) -> None:
        """Take up to ``most`` of the messages that wait, without another turn of the executor for each."""
        for message, info in waiting_messages(self._subscription, most):
            self._take(message, info)

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    def set_timeout(self, timeout_s: float) -> None:
        """Set the silence of the publisher after which another one takes its place."""
        for guard in self._guards.values():
            guard.timeout_s = timeout_s

    def problems(self) -> list[str]:
        """One line for each problem with the publishers since the last call."""
        found = [self._others] if self._others else []
        self._others = ""
        misfits = self._misfits()
        if misfits and not any(name == _UNKNOWN for name, _ in misfits):
            names, reasons = (" and ".join(dict.fromkeys(texts)) for texts in zip(*misfits, strict=True))
            topic = self._subscription.topic_name
            found.append(f"nothing comes from {names} on '{topic}': QoS does not fit, {reasons}")
            if found[-1] != self._misfit_said:
                self._misfit_said = found[-1]
                self._node.get_logger().warning(self._misfit_said)
        return found

    def _on_message(self, message: Any, info: dict[str, Any]) -> None:
        """Take a message, and those that wait behind it."""
        self._take(message, info)
        self.take_waiting(self._behind)

    def _take(self, message: Any, info: dict[str, Any]) -> None:
        publishers, identity = self._subscription.get_publisher_count(), self._identity(message)
        received_ns, sequence = info["received_timestamp"], info.get("publication_sequence_number")
        whose = identity if self._each_identity else None
        guard = self._guards.setdefault(whose, SourceGuard(self._guards[None].timeout_s))
        if guard.admits(publishers, identity, sequence, received_ns):
            self._callback(message)
            return
        if not self._others or _UNKNOWN in self._others:
            names = " and ".join(sorted(map(_name, self._publishers())))
            self._others = f"{names} publish on '{self._subscription.topic_name}': only the first that was heard counts"
        self._status.dropped(self._kind, OtherPublisher(self._others), warn=_UNKNOWN not in self._others)

    def _publishers(self) -> list[TopicEndpointInfo]:
        return list(self._node.get_publishers_info_by_topic(self._subscription.topic_name))

    def _misfits(self) -> list[tuple[str, str]]:
        """Names of the publishers whose QoS does not fit, and why."""
        checked = [
            (_name(info), *qos_check_compatible(info.qos_profile, self._subscription.qos_profile))
            for info in self._publishers()
        ]
        return sorted((name, _plain(reason)) for name, fits, reason in checked if fits == QoSCompatibility.ERROR)


def relative_poses(
    node: Node, status: NodeStatus, settings: NgoNodeSettings, take: Callable[[RelativePose], None]
) -> Input:
    """The relative poses of one robot, of which several are taken where the node fell behind."""
    topic, depth, timeout_s = settings.relative_pose_topic, settings.relative_pose_depth, settings.source_timeout_s
    return Input(node, status, RelativePose, topic, depth, take, _origin, timeout_s, at_once=AT_ONCE)


def _origin(message: RelativePose) -> int:
    return to_ns(message.origin_stamp)


def _plain(reason: str) -> str:
    """ "ERROR: Best effort publisher and reliable subscription;" without what is no news."""
    errors = [part.removeprefix("ERROR: ") for part in reason.split(";") if part.startswith("ERROR: ")]
    return ", ".join(error[:1].lower() + error[1:] for error in errors)


def _name(publisher: TopicEndpointInfo) -> str:
    if "UNKNOWN" in publisher.node_name:
        return _UNKNOWN
    return f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
