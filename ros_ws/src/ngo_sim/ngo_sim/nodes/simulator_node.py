"""The node that both worlds share: paces a simulation, takes actions from outside, publishes each frame."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from ngo_sim.flow_control import FlowControl, Pacer
from ngo_sim.nodes.consumers import Consumers
from ngo_sim.nodes.outputs import Outputs
from ngo_sim.nodes.parameters import BadParameter, ConfigParameters, changed
from ngo_sim.simulation import Frame, Simulation, World, yaw_quaternion_zw
from ngo_sim.simulator_config import SimulatorConfig

_LOOK_AT_GRAPH_S = 0.1
_IDLE_S = 0.05
# Taking messages costs more than a frame: between frames that follow at once it is done this often.
_LISTEN_S = 0.002


class SimulatorNode(Node):
    """Publishes the frames of one world; a subclass makes the world and publishes what the robot sees."""

    world_config_type: ClassVar[type]
    defaults: ClassVar[dict[str, Any]] = {}
    image_publisher: Publisher  # its subscribers are those that wait_for_subscribers counts

    def __init__(self, name: str) -> None:
        try:
            super().__init__(name)
        except InvalidParameterTypeException as error:  # of one of those that every node declares by itself
            raise BadParameter(str(error)) from None
        parameters = ConfigParameters(self)
        self.config = parameters.declare(SimulatorConfig, **self.defaults)
        self.world_config: Any = parameters.declare(self.world_config_type)
        parameters.finish()
        self.add_on_set_parameters_callback(self._on_parameters)
        self._consumers = Consumers(self, self.config.flow_control_topics, FlowControl(self.config.max_in_flight))
        # Deep enough that a reliable reader may be late with its acknowledgement by far more than what is in flight.
        qos = QoSProfile(depth=max(100, 2 * self.config.max_in_flight))
        self.outputs = Outputs(self, qos, self.config.record)
        self.outputs.set_time(time.time_ns() if self.config.use_wall_stamps else self.config.stamp_ns(0, 0.0))
        self._truth = self.outputs.create(Odometry, "ground_truth")
        self._action = self.outputs.create(DiscreteAction, "action")
        self._clock_out = self.outputs.create(Clock, "/clock") if self.config.publish_clock else None
        self.create_subscription(DiscreteAction, "action_command", self._on_command, QoSProfile(depth=100))
        try:
            self.simulation = Simulation(self.make_world(), self.config.seed, self.config.driver)
        except ValueError as error:  # what only the files or the world can say
            raise BadParameter(str(error)) from None
        self._pacer = Pacer()
        self._published = 0
        self._looked_s = 0.0
        self._stamp = Time()

    def destroy_node(self) -> None:
        """End the world and the recording, too."""
        self.outputs.close()
        self.simulation.world.close()
        super().destroy_node()

    @abstractmethod
    def make_world(self) -> World:
        """The world of world_config; the seed comes with its reset. Raises ValueError for a config that cannot be."""

    @abstractmethod
    def publish_sensors(self, frame: Frame, stamp: Time) -> None:
        """Publish what the robot sees."""

    def run(self, ended: Callable[[], bool]) -> None:
        """Publish frames until there are enough and all are taken, or until ``ended`` says so."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        listened_s = 0.0
        while not ended():
            now_s = time.monotonic()
            if now_s - self._looked_s >= _LOOK_AT_GRAPH_S:
                self._looked_s = now_s
                self._consumers.look()
            if 0 < self.config.frames <= self._published:
                if self._consumers.drained(now_s, self.config.stall_timeout_s):
                    self.image_publisher.wait_for_all_acked(Duration(seconds=5))
                    self.get_logger().info(f"published all {self._published} frames")
                    return
                idle_s = _IDLE_S
            elif (idle_s := self._idle_s(now_s)) == 0.0:
                self._publish_next(now_s)
            self.outputs.flush_if_due()
            if idle_s > 0.0 or now_s - listened_s >= _LISTEN_S:
                listened_s = now_s
                executor.spin_once(timeout_sec=idle_s)

    def _idle_s(self, now_s: float) -> float:
        """How long nothing is to be done before the next frame, 0 where it is due; messages end the wait earlier."""
        config = self.config
        if self._published == 0:
            awaited = self.image_publisher.get_subscription_count() < config.wait_for_subscribers or (
                config.wait_for_flow_control and not self._consumers.complete()
            )
            return _IDLE_S if awaited else 0.0
        if not self.simulation.ready(now_s, config.action_timeout_s, hold=config.rate > 0):
            return _IDLE_S
        if config.rate > 0:
            return min(_IDLE_S, self._pacer.remaining_s(now_s))
        return 0.0 if self._consumers.may_publish(now_s, config.stall_timeout_s) else _IDLE_S

    def _publish_next(self, now_s: float) -> None:
        config, simulation = self.config, self.simulation
        if self._published > 0:
            action = simulation.choose_action(now_s, config.action_timeout_s, hold=config.rate > 0)
            assert action is not None  # ready() said so
            message = DiscreteAction(action=int(action))
            message.header.stamp, message.header.frame_id = self._stamp, config.base_frame
            self._action.publish(message)
            simulation.advance(action)
        frame = simulation.frame
        simulated_ns = config.stamp_ns(frame.index, simulation.world.period_s)
        stamp_ns = time.time_ns() if config.use_wall_stamps else simulated_ns
        self._stamp = Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        self.outputs.set_time(stamp_ns)
        if self._clock_out is not None:
            self._clock_out.publish(Clock(clock=self._stamp))
        self._publish_truth(frame)
        self.publish_sensors(frame, self._stamp)
        self._published += 1
        self._consumers.published(stamp_ns, now_s)
        self._pacer.taken(now_s, config.rate)

    def _publish_truth(self, frame: Frame) -> None:
        message = Odometry(child_frame_id=self.config.base_frame)
        message.header.stamp, message.header.frame_id = self._stamp, self.config.ground_truth_frame
        x, y, yaw = frame.pose_xyyaw.tolist()
        pose, twist = message.pose.pose, message.twist.twist
        pose.position.x, pose.position.y = x, y
        pose.orientation.z, pose.orientation.w = yaw_quaternion_zw(yaw)
        twist.linear.x, twist.linear.y, twist.angular.z = frame.twist_xyyaw.tolist()
        self._truth.publish(message)

    def _on_command(self, message: DiscreteAction) -> None:
        try:
            self.simulation.external.command(message.action, time.monotonic())
        except ValueError as error:
            self.get_logger().warning(f"action_command dropped: {error}", throttle_duration_sec=5.0)

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        self.config, result = changed(self.config, parameters)
        return result
