"""A node that publishes at its pace: as fast as its consumers take, or so many frames a second."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from ngo_common.nodes.last_catch import spin_once
from ngo_common.nodes.name_watch import NameWatch
from ngo_sim.flow_control import FlowControl, Pacer
from ngo_sim.nodes.consumers import Consumers
from ngo_sim.nodes.outputs import Outputs
from ngo_sim.paced_config import PacedConfig

IDLE_S = 0.05
_LOOK_AT_GRAPH_S = 0.1
# Taking messages costs more than a frame: between frames that follow at once it is done this often.
_LISTEN_S = 0.002


class PacedNode(Node):
    """Publishes frames until there are enough and all are taken; a subclass makes them.

    It calls ``open_outputs`` when its parameters are known, and sets ``sensor``.
    """

    published_are: ClassVar[str] = "frames"
    sensor_is: ClassVar[str] = "image"
    sensor: Publisher  # wait_for_subscribers counts its subscribers

    def open_outputs(self, stamp_ns: int) -> None:
        """Begin the recording, and look for consumers; ``stamp_ns`` is that of what is published before a frame."""
        config = self.config
        self._name_watch = NameWatch(self)
        self._consumers = Consumers(self, config.flow_control_topics, FlowControl(config.max_in_flight))
        # Deep enough for late acknowledgements of a reliable reader: far more than the frames in flight.
        self.outputs = Outputs(self, QoSProfile(depth=max(100, 2 * config.max_in_flight)), config.record)
        self.outputs.set_time(stamp_ns)
        self._pacer = Pacer()
        self.published = 0
        self._looked_s = 0.0

    @property
    @abstractmethod
    def config(self) -> PacedConfig:
        """How the node runs, as it is set now."""

    @abstractmethod
    def publish_next(self, now_s: float) -> int:
        """Publish the next frame, and return its stamp in ns."""

    def has_next(self, now_s: float) -> bool:
        """Whether there is a next frame yet, beside its pace."""
        return True

    def destroy_node(self) -> None:
        """End the recording."""
        self.outputs.close()
        super().destroy_node()

    def run(self, ended: Callable[[], bool]) -> None:
        """Publish frames until there are enough and all are taken, or until ``ended`` says so."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        self.get_logger().info(self._ready_line())
        listened_s = 0.0
        while not ended():
            now_s = time.monotonic()
            if now_s - self._looked_s >= _LOOK_AT_GRAPH_S:
                self._looked_s = now_s
                self._consumers.look()
                self._name_watch.look()
            if 0 < self.config.frames <= self.published:
                if self._consumers.drained(now_s, self.config.stall_timeout_s):
                    self.outputs.wait_for_all_acked()
                    self.get_logger().info(f"published all {self.published} {self.published_are}")
                    return
                idle_s = IDLE_S
            elif (idle_s := self._idle_s(now_s)) == 0.0:
                stamp_ns = self.publish_next(now_s)
                self.published += 1
                self._consumers.published(stamp_ns, now_s)
                self._pacer.taken(now_s, self.config.rate)
            self.outputs.flush_if_due()
            if idle_s > 0.0 or now_s - listened_s >= _LISTEN_S:
                listened_s = now_s
                spin_once(self, executor, idle_s)

    def _ready_line(self) -> str:
        """The name of the node, its seed, rate and topics, and the subscribers that it waits for."""
        config, what, topics = self.config, self.published_are, ", ".join(sorted(self.outputs.topic_names))
        pace = f"{config.rate:g} {what} a second" if config.rate else f"as fast as the {what} are taken"
        subscribers = f"; waits for {config.wait_for_subscribers} subscribers of the {self.sensor_is}"
        waits = subscribers if config.wait_for_subscribers else ""
        return f"ready: {self.get_fully_qualified_name()}, seed {config.seed}, {pace}, publishes {topics}{waits}"

    def _idle_s(self, now_s: float) -> float:
        """Time until the next frame, 0 if it is due; messages end the wait earlier."""
        config = self.config
        if self.published == 0:
            awaited = self.sensor.get_subscription_count() < config.wait_for_subscribers or (
                config.wait_for_flow_control and not self._consumers.complete()
            )
            return IDLE_S if awaited else 0.0
        if not self.has_next(now_s):
            return IDLE_S
        if config.rate > 0:
            return min(IDLE_S, self._pacer.remaining_s(now_s))
        return 0.0 if self._consumers.may_publish(now_s, config.stall_timeout_s) else IDLE_S
