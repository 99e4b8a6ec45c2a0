"""An ngo_node fed with relative poses by the test, and what it publishes."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from ngo_msgs.msg import RelativePose
from std_srvs.srv import SetBool

from ngo_estimator.checkpoint import OPTIMIZER, PLACE, PlaceNetworks, save_checkpoint
from ngo_estimator.frontend.camera.local_odometry import LocalEstimate
from ngo_estimator.geometry import se2
from ngo_estimator.nodes.messages import relative_pose_message, relative_step, to_ns
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate
from tests.unit.ngo_estimator.samples import place_config, small_optimizer

from .estimator_graph import FIRST_RUN_NS, RUN_NS, STEP_NS
from .processes import Diagnostics, NodeProcess, Probe

POSITION_STD_M = 0.01
WORLD = "maze2d"


def write_weights(folder: Path) -> None:
    """Networks for ngo_node that are small and, with random weights, close loops and move every pose."""
    place = place_config(WORLD, code_size=12, embedding_size=8, pair_hidden_size=16)
    optimizer = small_optimizer("loops", trained=True)
    save_checkpoint(folder / f"{PLACE}.safetensors", PlaceNetworks(place), PLACE, WORLD, {})
    save_checkpoint(folder / f"{OPTIMIZER}.safetensors", optimizer, OPTIMIZER, WORLD, {})


class Drive:
    """Relative poses of a robot that drives through arcs, one a step, as local_node sends them."""

    def __init__(self, core: OnlineTrajectory, origin_ns: int, seed: int = 0, period_ns: int = STEP_NS) -> None:
        config = core._optimizer.config.aggregation
        assert core._pair_head is not None
        self._sizes = config.motion_feature_size, core._pair_head.config.code_length
        self._rng = np.random.default_rng(seed)
        self._odom = torch.zeros(3, dtype=torch.float64)
        self.origin_ns, self.period_ns = origin_ns, period_ns
        self._messages: list[RelativePose] = []

    def stamp_ns(self, step: int) -> int:
        """The stamp of a frame; frame 0 is the origin."""
        return self.origin_ns + step * self.period_ns

    def step(self, step: int) -> RelativePose:
        """The message of the step to a frame, from 1."""
        while len(self._messages) < step:
            self._messages.append(self._next())
        return relative_copy(self._messages[step - 1])

    def steps(self, first: int, last: int) -> list[RelativePose]:
        """The messages of the steps to the frames from ``first`` to ``last``, both included."""
        return [self.step(step) for step in range(first, last + 1)]

    def _next(self) -> RelativePose:
        step = len(self._messages) + 1
        relative = np.array([0.1, 0.0, 0.05]) + self._rng.normal(scale=0.01, size=3)
        self._odom = se2.compose(self._odom, torch.from_numpy(relative))
        motion, code = (self._rng.normal(size=size).astype(np.float32) for size in self._sizes)
        estimate = LocalEstimate(
            stamp_ns=self.stamp_ns(step),
            from_stamp_ns=self.stamp_ns(step - 1),
            relative_xyyaw=relative,
            covariance=np.diag([POSITION_STD_M, POSITION_STD_M, POSITION_STD_M]) ** 2,
            origin_stamp_ns=self.origin_ns,
            odom_xyyaw=self._odom.numpy(),
            motion_feature=motion,
            place_code=code,
            missed_frames=0,
        )
        return relative_pose_message(estimate, "base_link")


def relative_copy(message: RelativePose) -> RelativePose:
    """A message of its own with the same values."""
    copy = RelativePose()
    for name in message.get_fields_and_field_types():
        setattr(copy, name, getattr(message, name))
    return copy


class Optimizer:
    """A running ngo_node of the 2D world, and the probe that feeds it."""

    def __init__(self, process: NodeProcess, weights: Path, probe: Probe, namespace: str = "") -> None:
        self.process, self.weights, self.probe = process, weights, probe
        self.name = f"{namespace}/ngo_node"
        self.core = OnlineTrajectory.load(weights, iterations_per_step=1)  # as ngo_node by default
        self.publisher = probe.node.create_publisher(RelativePose, f"{namespace}/relative_pose", 5000)
        self.poses: list[PoseWithCovarianceStamped] = probe.collect(
            PoseWithCovarianceStamped, f"{namespace}/ngo/pose", 5000
        )
        self.diagnostics = Diagnostics(probe)
        self._origin_ns = FIRST_RUN_NS
        self.connect()

    def connect(self) -> None:
        """Meet the node, and see it answer."""
        self.meet()
        self.pose_after(self.drive().step(1))

    def meet(self) -> None:
        """Wait until node and probe know each other's ends of all topics."""
        self.probe.spin_until(lambda: self.publisher.get_subscription_count() == 1, "ngo_node's subscription")
        self.probe.meet(self.name)

    def drive(self, seed: int = 0, period_ns: int = STEP_NS) -> Drive:
        """A drive of a restarted source, long before the last one; nothing that it gives has come yet."""
        self._origin_ns -= RUN_NS
        self.poses.clear()
        self.core.reset()
        return Drive(self.core, self._origin_ns, seed, period_ns)

    def pose_after(self, *messages: RelativePose) -> PoseWithCovarianceStamped:
        """Publish relative poses, and return the pose of the last."""
        self.publish(*messages)
        return self.wait_for_stamp(to_ns(messages[-1].header.stamp))

    def publish(self, *messages: RelativePose) -> None:
        """Publish relative poses."""
        for message in messages:
            self.publisher.publish(message)

    def wait_for_stamp(self, stamp_ns: int) -> PoseWithCovarianceStamped:
        """Wait for the pose of this stamp, and return it."""
        self.probe.spin_until(
            lambda: self.poses and to_ns(self.poses[-1].header.stamp) == stamp_ns, f"the pose at {stamp_ns} ns"
        )
        return self.poses[-1]

    def stamps_ns(self) -> list[int]:
        """The stamps of the poses of this drive, in the order in which they came."""
        return [to_ns(pose.header.stamp) for pose in self.poses]

    def expected(self, messages: list[RelativePose], optimize: bool = True) -> TrajectoryUpdate:
        """What the core says after these messages, from the beginning."""
        self.core.reset()
        for message in messages:
            update = self.core.update(relative_step(message), optimize=optimize)
        return update

    def pause(self, paused: bool) -> str:
        """Have poses follow the odometry, or corrections go on; returns what the node says to it."""
        response = self.probe.call(SetBool, f"{self.name}/pause", SetBool.Request(data=paused))
        assert response.success, response.message
        return str(response.message)

    def wait_for_problem(self, *texts: str) -> str:
        """Wait until the node's diagnostics warn from now on with these texts, and return the message."""
        self.diagnostics.clear()
        return self.diagnostics.wait_for_problem(self.name, *texts)

    def wait_for_value(self, key: str, accepted: Any) -> str:
        """Wait until the diagnostics' value of ``key`` is accepted from now on, and return it."""
        self.diagnostics.clear()
        return self.diagnostics.wait_for_value(self.name, key, accepted)

    def count(self, key: str) -> int:
        """The count of ``key`` as it is now."""
        return int(self.wait_for_value(key, str.isdigit))

    def statuses(self) -> list[DiagnosticStatus]:
        """What the node said about itself since the list was cleared."""
        return self.diagnostics.statuses(self.name)


def assert_pose_is(message: PoseWithCovarianceStamped, update: TrajectoryUpdate) -> None:
    """The message holds what the core says."""
    pose = message.pose.pose
    x, y, yaw = update.pose_xyyaw.tolist()
    np.testing.assert_allclose((pose.position.x, pose.position.y), (x, y), atol=1e-5)
    np.testing.assert_allclose((pose.orientation.z, pose.orientation.w), (np.sin(yaw / 2), np.cos(yaw / 2)), atol=1e-5)
    covariance = np.array(message.pose.covariance).reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]
    np.testing.assert_allclose(covariance, update.covariance, rtol=1e-3, atol=1e-9)
