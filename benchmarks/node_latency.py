"""From message to answer: a real node on one core, fed over DDS from this process on another core."""

from __future__ import annotations

import sys
import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import Path as PathMessage
from ngo_msgs.msg import DiscreteAction, RelativePose
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from tqdm import tqdm

from benchmarks.drives import CACHE, drive_of, episodes, stamp_ns
from benchmarks.pinned import running_on
from benchmarks.process_use import memory_mb
from demo.graph import Graph, GraphError, NodeSpec
from ngo_estimator.frontend.camera.local_odometry import LocalEstimate
from ngo_estimator.nodes.messages import relative_pose_message, to_time
from ngo_sim.flow_control import header_stamp_ns

RATE_HZ = 35.0
_START_S, _ANSWER_S, _RETRY_S = 90.0, 60.0, 0.3
_IN_FLIGHT = 4
_ENCODINGS = {"maze2d": "32FC4", "maze3d": "rgb8"}

_PATH = ("ngo/path", PathMessage)

Frame = Sequence[tuple[str, Any]]
"""Topics and messages of one frame, in the order in which they are published; the answer is to the first of them."""


@dataclass(frozen=True)
class Latencies:
    """Of a node at ``RATE_HZ``: ``milliseconds`` of each frame, and frames/s before, at a pace of the node's own.

    ``resident_mb`` is its memory after all frames.
    """

    milliseconds: list[float]
    frames_per_s: float
    resident_mb: float

    def percentile(self, percent: float) -> float:
        """In ms."""
        return float(np.percentile(self.milliseconds, percent))


class Feed:
    """Publishes frames to a node, and remembers when the answer to each stamp came."""

    def __init__(self, graph: Graph, name: str, inputs: dict[str, type], answer: tuple[str, type]) -> None:
        self._graph, self._name = graph, name
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=graph.domain_id)
        self._node = rclpy.create_node(f"feed_of_{name}", context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers = {topic: self._node.create_publisher(kind, topic, 5000) for topic, kind in inputs.items()}
        topic, kind = answer
        keep_all = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=0)
        self._node.create_subscription(kind, topic, self._on_answer, keep_all, raw=True)
        self._sent: dict[int, float] = {}
        self.answered: dict[int, float] = {}

    def __enter__(self) -> Feed:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def connect(self, frames: Sequence[Frame], again: bool) -> int:
        """Send frames one by one (or the first one again and again) until an answer comes; returns how many were sent.

        Only then do both ends know each other.
        """
        self._graph.wait_for(
            lambda: all(publisher.get_subscription_count() for publisher in self._publishers.values()),
            "the node's subscriptions",
            _START_S,
            self._spin,
        )
        for number in range(len(frames)):
            self._send(frames[0 if again else number])
            until = time.monotonic() + _RETRY_S
            while time.monotonic() < until and not self.answered:
                self._spin()
            if self.answered:
                return 1 if again else number + 1
        raise RuntimeError(f"no answer to any of {len(frames)} frames")

    def fast(self, frames: Sequence[Frame]) -> float:
        """Send frames as the node takes them, a few at a time; returns frames/s once all are answered."""
        begin = time.monotonic()
        pending: list[int] = []
        for frame in tqdm(frames, f"{self._name} as fast as it can"):
            pending.append(self._send(frame))
            while len(pending) >= _IN_FLIGHT:
                self._wait(pending[0])
                pending = [stamp for stamp in pending if stamp not in self.answered]
        for stamp in pending:
            self._wait(stamp)
        return len(frames) / (time.monotonic() - begin)

    def paced(self, frames: Sequence[Frame], rate_hz: float = RATE_HZ) -> list[float]:
        """Send frames at a rate; returns how many ms each answer took once all have come."""
        begin, stamps = time.monotonic(), []
        for index, frame in enumerate(tqdm(frames, f"{self._name} at {rate_hz:g} Hz")):
            due = begin + index / rate_hz
            while (left := due - time.monotonic()) > 0.0:
                self._spin(left)
            stamps.append(self._send(frame))
        self._wait(stamps[-1])
        if lost := [number for number, stamp in enumerate(stamps) if stamp not in self.answered]:
            raise GraphError(
                f"{len(lost)} of {len(stamps)} frames were not answered, numbers {lost[0]} to {lost[-1]}; "
                f"{self._name} wrote last:\n{self._graph.tail(self._name)}"
            )
        return [1e3 * (self.answered[stamp] - self._sent[stamp]) for stamp in stamps]

    def hear(self) -> float:
        """Wait for a message on the answer's topic; returns when the first one came, by the monotonic clock."""
        what = f"the first message of {self._name}"
        self._graph.wait_for(lambda: bool(self.answered), what, _START_S, self._spin)
        return min(self.answered.values())

    def _send(self, frame: Frame) -> int:
        stamp = frame[0][1].header.stamp
        key = stamp.sec * 1_000_000_000 + stamp.nanosec
        self._sent[key] = time.monotonic()
        for topic, message in frame:
            self._publishers[topic].publish(message)
        return int(key)

    def _wait(self, stamp: int) -> None:
        self._graph.wait_for(lambda: stamp in self.answered, f"the answer to {stamp} ns", _ANSWER_S, self._spin)

    def _spin(self, timeout_s: float = 0.05) -> None:
        self._executor.spin_once(timeout_sec=timeout_s)

    def _on_answer(self, cdr: bytes) -> None:
        self.answered.setdefault(header_stamp_ns(cdr), time.monotonic())


def ngo_node(
    world_name: str, seed: int, window: int, live: int, cores: tuple[int, int], logs: Path, cache: Path = CACHE
) -> Latencies:
    """From relative pose to path, with the window full: ``window`` steps as fast as it goes, then ``live`` at 35 Hz."""
    frames = [
        [("relative_pose", relative_pose_message(LocalEstimate(**vars(step), missed_frames=0), "base_link"))]
        for step in drive_of(world_name, seed, window + live, cache).steps()
    ]
    # A path follows every message.
    parameters = {"world": world_name, "path_rate_hz": 0.0, "window_frames": window, "threads": 1}
    spec = NodeSpec("ngo_estimator", "ngo_node", parameters)
    inputs = {"relative_pose": RelativePose}
    return _measured(spec, inputs, _PATH, frames, live, cores, logs, again=True)


def local_node(world_name: str, seed: int, before: int, live: int, cores: tuple[int, int], logs: Path) -> Latencies:
    """From image to relative pose: ``before`` frames of the simulator as fast as it goes, then ``live`` at 35 Hz."""
    (episode,) = episodes(world_name, seed, before + live, before + live)
    frames = []
    for number, (picture, action) in enumerate(zip(episode.observations, episode.actions, strict=False)):
        header = Header(stamp=to_time(stamp_ns(number)), frame_id="base_link")
        height, width = picture.shape[:2] if picture.ndim == 3 else (1, len(picture))
        image = Image(header=header, height=height, width=width, encoding=_ENCODINGS[world_name])
        image.is_bigendian, image.step = sys.byteorder == "big", picture.nbytes // height
        image.data = array("B", picture.tobytes())
        frames.append([("image", image), ("action", DiscreteAction(header=header, action=int(action)))])
    spec = NodeSpec(
        "ngo_estimator",
        "local_node",
        {"world": world_name, "image_reliability": "reliable", "image_depth": 5000, "threads": 1},
    )
    inputs = {"image": Image, "action": DiscreteAction}
    return _measured(spec, inputs, ("relative_pose", RelativePose), frames, live, cores, logs, again=False)


def first_path_s(world_name: str, seed: int, cores: tuple[int, int], logs: Path) -> float:
    """Time from the start of both nodes, while the simulator's camera runs at 10 Hz, to the first path."""
    simulator = NodeSpec("ngo_sim", world_name, {"seed": seed, "rate": 10.0})
    nodes = [
        NodeSpec("ngo_estimator", name, {"world": world_name, "threads": 1}) for name in ("ngo_node", "local_node")
    ]
    with (
        Graph(logs) as graph,
        running_on(*cores),
        Feed(graph, world_name, {}, ("image", Image)) as camera,
        Feed(graph, "ngo_node", {}, _PATH) as path,
    ):
        graph.start(simulator)
        camera.hear()
        begin = time.monotonic()
        for node in nodes:
            graph.start(node)
        return path.hear() - begin


def _measured(
    spec: NodeSpec,
    inputs: dict[str, type],
    answer: tuple[str, type],
    frames: Sequence[Frame],
    live: int,
    cores: tuple[int, int],
    logs: Path,
    again: bool,
) -> Latencies:
    first = len(frames) - live
    node_core, own_core = cores
    with Graph(logs) as graph, running_on(own_core):
        with running_on(node_core):
            graph.start(spec)
        with Feed(graph, spec.executable, inputs, answer) as feed:
            sent = feed.connect(frames[:first], again)
            frames_per_s = feed.fast(frames[sent:first])
            milliseconds = feed.paced(frames[first:])
            resident_mb = memory_mb(graph.pid(spec.executable), "VmRSS")
    return Latencies(milliseconds, frames_per_s, resident_mb)
