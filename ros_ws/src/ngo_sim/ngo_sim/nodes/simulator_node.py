"""The node that all worlds share: drives a simulation, takes actions from outside, publishes each frame."""

from __future__ import annotations

import time
from abc import abstractmethod
from typing import Any, ClassVar

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import RunError
from ngo_common.settings import BadParameter, Settings
from ngo_sim.nodes.paced_node import PacedNode
from ngo_sim.nodes.velocity_input import VelocityInput
from ngo_sim.simulation import Frame, Simulation, World, inverse_pose, yaw_quaternion_zw
from ngo_sim.simulator_config import SimulatorConfig


class SimulatorNode(PacedNode):
    """Publishes the frames of one world; a subclass makes the world and publishes the sensors."""

    world_config_type: ClassVar[type[Settings]]
    defaults: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        super().__init__(name)
        types = SimulatorConfig, self.world_config_type
        self._live = LiveSettings(self, SimulatorConfig, defaults=self.defaults, beside=types)
        world = LiveSettings(self, self.world_config_type, beside=types)
        self.world_config: Any = world.values
        self._live.lock()
        world.lock()
        self.open_outputs(time.time_ns() if self.config.use_wall_stamps else self.config.stamp_ns(0, 0.0))
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
        self._stamp = Time()
        if transforms := self.static_transforms():
            # One message: of a second one on this topic, a subscriber that comes later would get that alone.
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.outputs.create(TFMessage, "/tf_static", latched).publish(TFMessage(transforms=transforms))

    def destroy_node(self) -> None:
        """End the recording and the world."""
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

    def has_next(self, now_s: float) -> bool:
        """Whether it is known what the robot does next."""
        config = self.config
        return self.simulation.ready(now_s, config.action_timeout_s, hold=config.rate > 0)

    def publish_next(self, now_s: float) -> int:
        """Drive on, and publish the frame; returns its stamp in ns."""
        config, simulation = self.config, self.simulation
        blocked = False
        if self.published > 0 and self._velocity is not None:
            _, blocked = simulation.drive()
        elif self.published > 0:
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
        return stamp_ns

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
