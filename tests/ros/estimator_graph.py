"""A pair of estimator nodes in the 2D world, fed by a publisher of the test, and what they publish."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from ngo_msgs.msg import DiscreteAction, RelativePose, Trajectory
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from ngo_estimator.frontend.camera.local_odometry import LocalEstimate, LocalOdometry
from ngo_estimator.nodes.messages import to_ns, to_time

from .processes import Diagnostics, NodeProcess, Probe

STEP_NS = 100_000_000
RUN_NS = 1_000_000_000_000
FIRST_RUN_NS = 1_700_000_000_000_000_000


def scan(seed: int) -> np.ndarray:
    """A row image of the 2D world's format."""
    rng = np.random.default_rng(seed)
    return np.concatenate((rng.random((1, 241, 3)), rng.uniform(0.3, 8.0, (1, 241, 1))), axis=-1).astype(np.float32)


def image_message(pixels: np.ndarray, stamp_ns: int) -> Image:
    """What a simulator publishes for these pixels."""
    height, width, channels = pixels.shape
    message = Image(height=height, width=width, step=width * channels * pixels.itemsize, data=pixels.tobytes())
    message.encoding = "rgb8" if pixels.dtype == np.uint8 else "32FC4"
    message.header.stamp = to_time(stamp_ns)
    return message


@dataclass
class Outputs:
    """Everything that the nodes published, topic by topic."""

    relative_poses: list[RelativePose] = field(default_factory=list)
    odometry: list[Odometry] = field(default_factory=list)
    poses: list[PoseWithCovarianceStamped] = field(default_factory=list)
    trajectories: list[Trajectory] = field(default_factory=list)
    paths: list[PathMessage] = field(default_factory=list)
    loops: list[MarkerArray] = field(default_factory=list)
    transforms: list[TFMessage] = field(default_factory=list)

    def lists(self) -> list[list[Any]]:
        """All lists of messages."""
        return list(vars(self).values())


class Graph:
    """A running pair of estimators in the 2D world, and the probe that plays runs into it."""

    def __init__(self, local: NodeProcess, ngo: NodeProcess, weights: Path, probe: Probe) -> None:
        self.local, self.ngo, self.weights, self.probe = local, ngo, weights, probe
        self.images = probe.node.create_publisher(Image, "image", 1000)
        self.actions = probe.node.create_publisher(DiscreteAction, "action", 1000)
        self.out = Outputs(
            probe.collect(RelativePose, "relative_pose"),
            probe.collect(Odometry, "odom"),
            probe.collect(PoseWithCovarianceStamped, "ngo/pose"),
            probe.collect(Trajectory, "ngo/trajectory"),
            probe.collect(PathMessage, "ngo/path"),
            probe.collect(MarkerArray, "ngo/loops"),
            probe.collect(TFMessage, "/tf"),
        )
        self.diagnostics = Diagnostics(probe)
        self._base_ns = FIRST_RUN_NS

    def connect(self) -> None:
        """Play runs until every topic has arrived: only then does local_node know that ngo_node listens, too."""
        self.probe.spin_until(
            lambda: self.images.get_subscription_count() and self.actions.get_subscription_count(),
            "subscribers",
        )
        self.probe.meet("local_node", "ngo_node")

        def all_arrived() -> bool:
            self._base_ns -= RUN_NS
            self.play(0, 1)
            return all(self.out.lists())

        self.probe.spin_until(all_arrived, "every topic")
        self.finish_run(frames=3)

    def start_run(self) -> None:
        """Let the next frames be those of a restarted simulator."""
        self._base_ns -= RUN_NS
        for messages in self.out.lists():
            messages.clear()

    def finish_run(self, frames: int) -> None:
        """Play a whole run of ``frames`` frames and wait until everything about it has arrived."""
        self.start_run()
        self.play(*range(frames))
        self.wait_for_step(frames - 1)

    def stamp_ns(self, step: int) -> int:
        """The stamp of a frame of this run."""
        return self._base_ns + step * STEP_NS

    def action(self, step: int, action: int | None = None) -> None:
        """Publish the action taken at a frame."""
        message = DiscreteAction(action=step % 3 if action is None else action)
        message.header.stamp = to_time(self.stamp_ns(step))
        self.actions.publish(message)

    def frame(self, step: int, pixels: np.ndarray | None = None) -> None:
        """Publish a frame."""
        self.images.publish(image_message(scan(step) if pixels is None else pixels, self.stamp_ns(step)))

    def play(self, *steps: int) -> None:
        """Publish frames, each after the action taken at the step before it."""
        for step in steps:
            if step > 0:
                self.action(step - 1)
            self.frame(step)

    def wait_for_step(self, step: int) -> None:
        """Wait until the newest message on every topic is about this step."""

        expected = self.stamp_ns(step)

        def newest(messages: list[Any]) -> int:
            if not messages:
                return 0
            if isinstance(messages[-1], MarkerArray):
                return expected  # published when the optimizer ran
            if isinstance(messages[-1], TFMessage):
                children = {message.transforms[0].child_frame_id: message for message in messages}
                stamps = [to_ns(message.transforms[0].header.stamp) for message in children.values()]
                return min(stamps) if len(stamps) == 2 else 0
            return to_ns(messages[-1].header.stamp)

        self.probe.spin_until(
            lambda: all(newest(m) == expected for m in self.out.lists()), f"step {step} on every topic"
        )

    def steps(self) -> list[tuple[int, int]]:
        """The steps of this run that relative poses came for: (older, newer)."""
        return [
            tuple((to_ns(stamp) - self._base_ns) // STEP_NS for stamp in (message.from_stamp, message.header.stamp))
            for message in self.out.relative_poses
        ]

    def expected(self, *steps: int) -> list[LocalEstimate]:
        """What the core says about these frames with the action of each older one."""
        core = LocalOdometry.load(self.weights)
        estimates = []
        for older, newer in zip((steps[0], *steps), steps, strict=False):
            estimate = core.update(self.stamp_ns(newer), scan(newer), older % 3)
            estimates += [] if estimate is None else [estimate]
        return estimates
