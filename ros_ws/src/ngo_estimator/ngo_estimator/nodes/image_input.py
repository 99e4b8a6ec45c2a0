"""The input of ``local_node`` where networks estimate the motion: images or resampled scans, actions, velocities."""

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from ngo_common.nodes.process import StartError
from ngo_estimator.data.relative_step import UNFAMILIAR, RelativeStep
from ngo_estimator.frontend.camera.familiarity_watch import NOT_FITTED
from ngo_estimator.frontend.camera.frame_pairing import FramePairing, PairedFrame
from ngo_estimator.frontend.camera.local_odometry import AT_ONCE, LocalOdometry
from ngo_estimator.frontend.rejected_frames import RejectedFrame
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.inputs import Input
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.sensors import sensor_array, sensor_topic
from ngo_estimator.nodes.settings import LocalNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.weights import load_core

_ACTIONS = (DiscreteAction.FORWARD, DiscreteAction.TURN_LEFT, DiscreteAction.TURN_RIGHT)
_TWISTS = {"TwistStamped": TwistStamped, "Twist": Twist, "Odometry": Odometry}
_DEPTH = 1000


class ImageInput:
    """Subscribes to the inputs of the networks in the weights, and hands on an estimate for each pair of frames.

    Args:
        publish: takes each estimate, and None where the odometry starts anew.
    """

    def __init__(self, node: Node, settings: LocalNodeSettings, publish: Callable[[RelativeStep | None], None]) -> None:
        self._node, self._settings, self._publish = node, settings, publish
        self._core = load_core(LocalOdometry.load, settings)
        image_format = self._core.image_format
        topics = settings.image_topic, settings.scan_topic
        try:
            self._sensor_type, topic = sensor_topic(image_format, *topics, settings.image_transport == "compressed")
        except ValueError as error:
            raise StartError(f"parameter 'image_transport': {error}") from error
        self._sensor_topic, self._sensor = topic, "scan" if image_format.is_scan else "image"
        self._observe: Callable[[Any], np.ndarray] = partial(
            sensor_array, image_format=image_format, topic=topic, scan_yaw_rad=math.radians(settings.scan_yaw_deg)
        )
        self._pairing = FramePairing(
            self._core.uses_action,
            int(settings.action_timeout_s * 1e9),
            settings.action_capacity,
            self._core.uses_twist,
            int(settings.twist_tolerance_s * 1e9),
        )
        self._sensor_and_side: tuple[Input, list[Input]] | None = None
        self._taking = False
        self._most_at_once = 0
        self._missed = self._newly_missed = 0
        self._unlikeness, self._largest_unlikeness = 0.0, 0.0
        self._unfamiliar = self._repeated = self._newly_unfamiliar = self._newly_repeated = 0
        if not self._core.tells_unlike_input:
            node.get_logger().info(NOT_FITTED)

    @property
    def description(self) -> str:
        """What the input listens to, in words."""
        return f"{self._sensor_type.__name__} on '{self._node.resolve_topic_name(self._sensor_topic)}'"

    def listen(self, listening: Listening, status: NodeStatus) -> None:
        """Subscribe to everything that the networks take."""
        self._status, settings = status, self._settings
        reliability = ReliabilityPolicy[settings.image_reliability.upper()]
        image_qos = QoSProfile(depth=settings.image_depth, reliability=reliability)
        sensor = listening.to(self._sensor_type, self._sensor_topic, self._on_sensor, image_qos)
        side, qos = [], QoSProfile(depth=_DEPTH)
        if self._core.uses_action:
            side.append(listening.to(DiscreteAction, settings.action_topic, self._on_action, qos))
        if self._core.uses_twist:
            side.append(listening.to(_TWISTS[settings.twist_type], settings.twist_topic, self._on_twist, qos))
        self._sensor_and_side = sensor, side

    def _on_sensor(self, message: Any) -> None:
        stamp_ns = messages.to_ns(message.header.stamp)
        try:
            self._pairing.add_frame(stamp_ns, self._observe(message))
        except ValueError as error:
            self._status.dropped(self._sensor, error)
            return
        self._status.received(stamp_ns)
        self._update()

    def _on_action(self, message: DiscreteAction) -> None:
        if message.action not in _ACTIONS:
            self._status.dropped("action", f"action is {message.action}; expected one of {_ACTIONS}")
            return
        self._pairing.add_action(messages.to_ns(message.header.stamp), message.action)
        self._update()

    def _on_twist(self, message: Twist | TwistStamped | Odometry) -> None:
        stamp_ns, twist_xyyaw = messages.stamped_twist(message, self._node.get_clock().now().nanoseconds)
        try:
            self._pairing.add_twist(stamp_ns, twist_xyyaw)
        except ValueError as error:
            self._status.dropped("twist", error)
            return
        self._update()

    def _update(self) -> None:
        """Publish the steps to all frames that are here.

        A node that fell behind finds several that wait, and catches up: together they cost much less.
        """
        if self._taking or self._sensor_and_side is None:
            return
        sensor, side = self._sensor_and_side
        self._taking = True
        try:
            sensor.take_waiting(AT_ONCE - 1)
            # After the images, and all of them: what led to an image was published before it, and else seems lost.
            for entry in side:
                entry.take_waiting(_DEPTH)
        finally:
            self._taking = False
        dropped, restarts = self._pairing.dropped, self._core.restarts
        pairs = list(self._pairing.ready())
        while pairs:
            self._run(pairs[:AT_ONCE])
            del pairs[:AT_ONCE]
        if self._pairing.dropped > dropped:
            controls = [f"action on '{self._settings.action_topic}'"] if self._core.uses_action else []
            controls += [f"velocity on '{self._settings.twist_topic}'"] if self._core.uses_twist else []
            kind = f"{self._sensor} without {'action' if self._core.uses_action else 'velocity'}"
            reason = f"the {' or the '.join(controls)} that led to it did not come"
            self._status.dropped(kind, reason, self._pairing.dropped - dropped)
        if self._core.restarts > restarts:
            self._node.get_logger().info(
                f"the {self._sensor}s' stamps jumped back: their source restarted, so the odometry starts anew"
            )

    def _run(self, pairs: list[PairedFrame]) -> None:
        """Run the networks over the next frames, and publish their steps in order."""
        began_s = time.perf_counter()
        try:
            estimates = self._core.update_all(pairs)
        except Exception:
            if len(pairs) == 1:
                raise
            self._run_one_by_one(pairs)
            return
        self._most_at_once = max(self._most_at_once, len(pairs))
        took_s = (time.perf_counter() - began_s) / len(pairs)
        for estimate in estimates:
            if isinstance(estimate, RejectedFrame):
                self._status.dropped(self._sensor, estimate)
                continue
            self._status.took("time an update", took_s)
            if estimate is not None:
                self._missed += estimate.missed_frames
                self._newly_missed += estimate.missed_frames
                self._count_unlike(estimate.unlikeness, estimate.repeated)
            self._publish(estimate)

    def _run_one_by_one(self, pairs: list[PairedFrame]) -> None:
        """Run what failed together, so that one frame costs no other; raises the first error at the end."""
        errors = []
        for pair in pairs:
            try:
                self._run([pair])
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def _count_unlike(self, unlikeness: float, repeated: bool) -> None:
        self._unlikeness = unlikeness
        self._largest_unlikeness = max(self._largest_unlikeness, unlikeness)
        unfamiliar = unlikeness > UNFAMILIAR
        self._unfamiliar, self._newly_unfamiliar = self._unfamiliar + unfamiliar, self._newly_unfamiliar + unfamiliar
        self._repeated, self._newly_repeated = self._repeated + repeated, self._newly_repeated + repeated

    def reset(self) -> str:
        """Start anew with the next frame; returns what that means, in words."""
        self._core.reset()
        self._pairing.reset()
        return "the next image is the new origin of the odometry"

    def details(self) -> dict[str, str]:
        """Values for diagnostics."""
        unlike = {
            "unlikeness (over 1: unfamiliar)": f"{self._unlikeness:.3g}",
            "largest unlikeness": f"{self._largest_unlikeness:.3g}",
            "unfamiliar frames": str(self._unfamiliar),
            "repeated frames": str(self._repeated),
        }
        waiting = f"{self._sensor}s waiting for {'velocities' if self._core.uses_twist else 'actions'}"
        return {
            waiting: str(self._pairing.waiting),
            f"most {self._sensor}s at once": str(self._most_at_once),
            "missed frames": str(self._missed),
            "restarts": str(self._core.restarts),
            **(unlike if self._core.tells_unlike_input else {}),
        }

    def problems(self) -> list[str]:
        """A line for each thing that was wrong since the last call."""
        lines = []
        if self._newly_missed:
            lines.append(f"{self._newly_missed} frames missing between images, bridged with a larger covariance")
        if self._newly_repeated:
            lines.append(
                f"{self._newly_repeated} {self._sensor}s repeat the one before while the robot is told to move"
            )
        if others := self._newly_unfamiliar - self._newly_repeated:
            lines.append(
                f"{others} {self._sensor}s are unlike what the networks learned from (unlikeness up to "
                f"{self._largest_unlikeness:.3g}, 1 is the limit): the covariance grows"
            )
        self._newly_missed = self._newly_repeated = self._newly_unfamiliar = 0
        return lines
