"""The node that all worlds share: paces a simulation, takes actions from outside, publishes each frame."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.last_catch import spin_once
from ngo_common.nodes.name_watch import NameWatch
from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import RunError
from ngo_common.settings import BadParameter, Settings
from ngo_sim.flow_control import FlowControl, Pacer
from ngo_sim.nodes.consumers import Consumers
from ngo_sim.nodes.outputs import Outputs
from ngo_sim.nodes.velocity_input import VelocityInput
from ngo_sim.simulation import Frame, Simulation, World, inverse_pose, yaw_quaternion_zw
from ngo_sim.simulator_config import SimulatorConfig

_LOOK_AT_GRAPH_S = 0.1
_IDLE_S = 0.05
# Taking messages costs more than a frame: between frames that follow at once it is done this often.
_LISTEN_S = 0.002


class SimulatorNode(Node):
    """Publishes the frames of one world; a subclass makes the world and publishes the sensors."""

    world_config_type: ClassVar[type[Settings]]
    defaults: ClassVar[dict[str, Any]] = {}
    image_publisher: Publisher  # wait_for_subscribers counts its subscribers

    def __init__(self, name: str) -> None:
        super().__init__(name)
        types = SimulatorConfig, self.world_config_type
        self._live = LiveSettings(self, SimulatorConfig, defaults=self.defaults, beside=types)
        world = LiveSettings(self, self.world_config_type, beside=types)
        self.world_config: Any = world.values
        self._live.lock()
        world.lock()
        self._name_watch = NameWatch(self)
        self._consumers = Consumers(self, self.config.flow_control_topics, FlowControl(self.config.max_in_flight))
        # Deep enough for late acknowledgements of a reliable reader: far more than the frames in flight.
        qos = QoSProfile(depth=max(100, 2 * self.config.max_in_flight))
        self.outputs = Outputs(self, qos, self.config.record)
        self.outputs.set_time(time.time_ns() if self.config.use_wall_stamps else self.config.stamp_ns(0, 0.0))
        self._truth = self.outputs.create(Odometry, "ground_truth")
        self._action = self.outputs.create(DiscreteAction, "action")
        self._clock_out = self.outputs.create(Clock, "/clock") if self.config.publish_clock else None
        self.create_subscription(DiscreteAction, "action_command", self._on_command, QoSProfile(depth=100))
        try:
            config = self.config
            maze_seed = None if config.maze_seed < 0 else config.maze_seed
            self.simulation = Simulation(
                self.make_world(), config.seed, config.driver, maze_seed, config.cmd_vel_timeout_s
            )
        except ValueError as error:  # an error that only the files or the world can show
            raise BadParameter(str(error)) from None
        command = self.simulation.velocity
        self._velocity = VelocityInput(self, self.outputs, command.set) if command is not None else None
        self._pacer = Pacer()
        self._published = 0
        self._looked_s = 0.0
        self._stamp = Time()
        if transforms := self.static_transforms():
            # One message: of a second one on this topic, a subscriber that comes later would get that alone.
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.outputs.create(TFMessage, "/tf_static", latched).publish(TFMessage(transforms=transforms))

    def destroy_node(self) -> None:
        """End the recording and the world."""
        self.outputs.close()
        self.simulation.world.close()
        super().destroy_node()

    @abstractmethod
    def make_world(self) -> World:
        """The world of world_config; the seed comes with its reset. Raises ValueError for an impossible config."""

    @abstractmethod
    def publish_sensors(self, frame: Frame, stamp: Time) -> None:
        """Publish the sensors of a frame."""

    @property
    def config(self) -> SimulatorConfig:
        """How the node runs, as it is set now."""
        return self._live.values

    def framed(self, name: str) -> str:
        """The name of a frame with this robot's prefix."""
        return self.config.framed(name)

    def static_transforms(self) -> list[TransformStamped]:
        """Transforms for /tf_static: where the ground truth begins, on request."""
        if not self.config.truth_parent_frame:
            return []
        placed = TransformStamped(child_frame_id=self.framed(self.config.ground_truth_frame))
        placed.header.frame_id = self.framed(self.config.truth_parent_frame)
        x, y, yaw = inverse_pose(self.simulation.frame.pose_xyyaw)
        placed.transform.translation.x, placed.transform.translation.y = x, y
        placed.transform.rotation.z, placed.transform.rotation.w = yaw_quaternion_zw(yaw)
        return [placed]

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
            if 0 < self.config.frames <= self._published:
                if self._consumers.drained(now_s, self.config.stall_timeout_s):
                    self.outputs.wait_for_all_acked()
                    self.get_logger().info(f"published all {self._published} frames")
                    return
                idle_s = _IDLE_S
            elif (idle_s := self._idle_s(now_s)) == 0.0:
                self._publish_next(now_s)
            self.outputs.flush_if_due()
            if idle_s > 0.0 or now_s - listened_s >= _LISTEN_S:
                listened_s = now_s
                spin_once(self, executor, idle_s)

    def _ready_line(self) -> str:
        """The name of the node, its seed, rate and topics, and the subscribers that it waits for."""
        config, topics = self.config, ", ".join(sorted(self.outputs.topic_names))
        pace = f"{config.rate:g} frames a second" if config.rate else "as fast as the frames are taken"
        subscribers = f"; waits for {config.wait_for_subscribers} subscribers of the image"
        waits = subscribers if config.wait_for_subscribers else ""
        name = self.get_fully_qualified_name()
        return f"ready: {name}, seed {config.seed}, {pace}, publishes {topics}{waits}"

    def _idle_s(self, now_s: float) -> float:
        """Time until the next frame, 0 if it is due; messages end the wait earlier."""
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
        blocked = False
        if self._published > 0 and self._velocity is not None:
            _, blocked = simulation.drive()
        elif self._published > 0:
            action = simulation.choose_action(now_s, config.action_timeout_s, hold=config.rate > 0)
            assert action is not None  # ready() said so
            message = DiscreteAction(action=int(action))
            message.header.stamp, message.header.frame_id = self._stamp, self.framed(config.base_frame)
            self._action.publish(message)
            try:
                simulation.advance(action)
            except RuntimeError as error:  # the world's process has ended
                raise RunError(str(error)) from None
        frame = simulation.frame
        simulated_ns = config.stamp_ns(frame.index, simulation.world.period_s)
        stamp_ns = time.time_ns() if config.use_wall_stamps else simulated_ns
        self._stamp = Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        self.outputs.set_time(stamp_ns)
        if self._clock_out is not None:
            self._clock_out.publish(Clock(clock=self._stamp))
        self._publish_truth(frame)
        if self._velocity is not None:
            self._velocity.publish(blocked, frame.pose_xyyaw, self._stamp, self.framed(config.ground_truth_frame))
        self.publish_sensors(frame, self._stamp)
        self._published += 1
        self._consumers.published(stamp_ns, now_s)
        self._pacer.taken(now_s, config.rate)

    def _publish_truth(self, frame: Frame) -> None:
        message = Odometry(child_frame_id=self.framed(self.config.base_frame))
        message.header.stamp, message.header.frame_id = self._stamp, self.framed(self.config.ground_truth_frame)
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
