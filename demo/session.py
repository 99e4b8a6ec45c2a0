"""One run of the graph: start the three nodes, record until every frame is through, end them, evaluate."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose
from nav2_msgs.srv import SaveMap
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import deserialize_message

from benchmarks.process_use import memory_mb
from demo.graph import Graph, GraphError, NodeSpec
from demo.picture import save_picture
from demo.recording import ALL_TOPICS, StampTimes
from demo.trajectories import Poses, evaluate, match
from ngo_estimator.mapping.map_files import read_map
from ngo_estimator.mapping.scan_source import scan_source
from ngo_estimator.trajectory.files import write_tum
from ngo_sim.flow_control import header_stamp_ns
from ngo_sim.mazes import Maze
from training.common.records import WEIGHTS
from training.recordings.recorder import Recorder

START_TIMEOUT_S = 180.0  # the first start after an installation compiles
SILENCE_TIMEOUT_S = 60.0  # How long nothing at all may come through before a run counts as stuck.

MAP_INTERVAL_S = 2.0  # Whole maps are recorded: a few are enough.

MAP = "map"  # Name of the map's files.

Show = Callable[[str, int], None]  # Called with what is going on and how many frames are through.


@dataclass(frozen=True)
class SessionConfig:
    """Which maze is driven, how fast, with which weights (None: those that ship), and how many views listen, too."""

    world: str
    seed: int
    frames: int
    rate: float = 0.0
    weights: Path | None = None
    views: int = 0

    @property
    def draws_map(self) -> bool:
        """Whether the weights see ranges, which a map needs."""
        weights = self.weights or WEIGHTS / self.world
        try:
            return scan_source(weights) is not None
        except ValueError:
            return False  # a node says what is wrong with them

    def estimators(self, out: Path) -> list[NodeSpec]:
        """The estimator nodes, which may write below ``out``; images come reliably: a demo must not depend on luck."""
        weights = {} if self.weights is None else {"weights": str(self.weights.resolve())}
        window = {"window_frames": max(2000, self.frames), "relative_pose_depth": max(2000, self.frames)}
        local = {
            "image_reliability": "reliable",
            "image_depth": 100,
            "relative_pose_depth": window["relative_pose_depth"],
        }
        depth = {"relative_pose_depth": window["relative_pose_depth"]}
        writes = {"map_update_interval": MAP_INTERVAL_S, "save_directory": str(out.absolute())}
        # At some hundred frames a second a path is out of the usual queue before a busy recorder has it.
        kept = {f"qos_overrides./ngo/{name}.publisher.depth": 100 for name in ("path", "trajectory")}
        corrected = {"path_rate_hz": 0.0, **window, **kept}
        mapper = {"world": self.world, **writes, **depth, **weights}
        return [
            # A path after every frame, for the latency.
            NodeSpec("ngo_estimator", "ngo_node", {"world": self.world, **corrected, **weights}),
            NodeSpec("ngo_estimator", "local_node", {"world": self.world, **local, **weights}),
            *([NodeSpec("ngo_estimator", "ngo_map", mapper)] if self.draws_map else []),
        ]

    def simulator(self) -> NodeSpec:
        """The simulator, which waits for local_node, the recorder and the views."""
        return NodeSpec(
            "ngo_sim",
            self.world,
            {
                "seed": self.seed,
                "frames": self.frames,
                "rate": float(self.rate),
                "wait_for_subscribers": 2 + self.views,
                "wait_for_flow_control": True,
                # Enough for local_node to take eight at once while ngo_node takes those before them.
                "max_in_flight": 16,
            },
        )


class Session:
    """Runs the graph once; everything it leaves behind lies below out."""

    def __init__(self, config: SessionConfig, out: Path, domain_id: int | None = None) -> None:
        """Run in a ROS domain that is free, or in ``domain_id``."""
        self._config = config
        self._domain_id = domain_id
        self._out = out
        self._truth: dict[int, bytes] = {}
        self._odometry: dict[int, bytes] = {}
        self._path = b""
        self._memory_mb: list[dict[str, float]] = []  # of each estimator, after half of the frames and after all
        self._image_times, self._path_times = StampTimes(), StampTimes()

    def run(self, show: Show, with_latency: bool = False) -> dict[str, Any]:
        """Run, write recording.mcap, picture.png, the map, the trajectories and the logs, and return the result."""
        config = self._config
        with (
            Graph(self._out / "logs", self._domain_id) as graph,
            Recorder(self._out / "recording.mcap", graph.domain_id, ALL_TOPICS) as recorder,
        ):
            recorder.listen("ground_truth", self._on_truth)
            recorder.listen("odom", self._on_odometry)
            recorder.listen("ngo/path", self._on_path)
            recorder.listen("image", self._image_times)
            show("loading the networks", 0)
            for spec in config.estimators(self._out):
                graph.start(spec)
            draws_map = config.draws_map
            # The recorder subscribes relative_pose and image, too: the estimators are up when there are more of each.
            graph.wait_for(
                lambda: (
                    recorder.has_publisher("ngo/path")
                    and recorder.has_publisher("odom")
                    and recorder.has_subscriber("relative_pose", besides=2 if draws_map else 1)
                    and (recorder.has_subscriber("ngo/trajectory", besides=1 + config.views) or not draws_map)
                    and recorder.has_subscriber("image", besides=1 + config.views)
                ),
                "the estimators to come up",
                START_TIMEOUT_S,
                recorder.spin_once,
            )
            show("starting the world", 0)
            graph.start(config.simulator())
            graph.wait_for(lambda: bool(self._truth), "the first frame", START_TIMEOUT_S, recorder.spin_once)
            self._record(graph, recorder, show)
            self._measure_memory(graph)
            if draws_map:
                self._save_map(graph, recorder)
            graph.stop()
        return self._evaluate(with_latency)

    def _record(self, graph: Graph, recorder: Recorder, show: Show) -> None:
        heard, heard_s = 0, time.monotonic()
        while not (graph.exit_code(self._config.world) == 0 and self._path_times.newest_ns >= max(self._truth)):
            recorder.spin_once()
            graph.check()
            now_s = time.monotonic()
            if (total := sum(recorder.counts.values()) - recorder.counts["/diagnostics"]) != heard:
                heard, heard_s = total, now_s
            elif now_s - heard_s > SILENCE_TIMEOUT_S:
                raise GraphError(
                    f"nothing came through for {SILENCE_TIMEOUT_S:g} s after {len(self._truth)} frames; "
                    + "; ".join(
                        f"{name} wrote last:\n{graph.tail(name)}"
                        for name in (self._config.world, "local_node", "ngo_node")
                    )
                )
            frames = len(self._path_times.received_ns) + 1
            if not self._memory_mb and frames >= self._config.frames // 2:
                self._measure_memory(graph)
            show("driving", frames)

    def _measure_memory(self, graph: Graph) -> None:
        names = [spec.executable for spec in self._config.estimators(self._out)]
        self._memory_mb.append({name: round(memory_mb(graph.pid(name), "VmRSS"), 1) for name in names})

    def _save_map(self, graph: Graph, recorder: Recorder) -> None:
        client = recorder.node.create_client(SaveMap, "ngo_map/save_map")
        graph.wait_for(client.service_is_ready, "ngo_map", START_TIMEOUT_S, recorder.spin_once)
        future = client.call_async(SaveMap.Request(map_url=str((self._out / MAP).absolute())))
        graph.wait_for(future.done, "the map", SILENCE_TIMEOUT_S, recorder.spin_once)
        if not future.result().result:
            raise GraphError(f"the map was not saved; ngo_map wrote last:\n{graph.tail('ngo_map')}")

    def _evaluate(self, with_latency: bool) -> dict[str, Any]:
        message = deserialize_message(self._path, PathMessage)
        corrected = {_stamp_ns(pose.header.stamp): _xyyaw(pose.pose) for pose in message.poses}
        try:
            trajectories = match(_poses(self._truth), _poses(self._odometry), corrected)
        except ValueError as error:
            raise GraphError(str(error)) from None
        result = evaluate(self._config.world, self._config.seed, trajectories)
        result["memory_mb"] = {"half": self._memory_mb[0], "end": self._memory_mb[-1]}
        if with_latency:
            result["latency_ms"] = self._latency_ms()
        for name in ("truth", "odometry", "corrected"):
            write_tum(self._out / f"{name}.tum", trajectories.stamps_ns, getattr(trajectories, name))
        maze = maze_of(self._config.world, self._config.seed)
        found = read_map(self._out / f"{MAP}.yaml") if self._config.draws_map else None
        save_picture(self._out / "picture.png", maze, trajectories, result, found)
        if (lost := trajectories.frames_published - len(trajectories.stamps_ns)) > 0:
            print(f"{lost} of {trajectories.frames_published} frames did not get into the corrected path")
        return result

    def _latency_ms(self) -> dict[str, float]:
        images, paths = self._image_times.published_ns, self._path_times.received_ns
        latencies = np.array([paths[stamp] - images[stamp] for stamp in paths.keys() & images.keys()]) / 1e6
        median, p99 = np.percentile(latencies, [50, 99])
        return {
            "median": round(float(median), 2),
            "p99": round(float(p99), 2),
            "max": round(float(latencies.max()), 2),
            "frames": len(latencies),
        }

    def _on_truth(self, cdr: bytes, published_ns: int, received_ns: int) -> None:
        self._truth[header_stamp_ns(cdr)] = cdr

    def _on_odometry(self, cdr: bytes, published_ns: int, received_ns: int) -> None:
        self._odometry[header_stamp_ns(cdr)] = cdr

    def _on_path(self, cdr: bytes, published_ns: int, received_ns: int) -> None:
        self._path = cdr
        self._path_times(cdr, published_ns, received_ns)


def maze_of(world: str, seed: int) -> Maze:
    """The maze that the simulator of this name drives through, of its standard size."""
    if world == "maze2d":
        from ngo_sim.maze2d import Maze2D

        env: Any = Maze2D()
    else:
        from ngo_sim.maze3d import Maze3D  # loads the engine, which the 2D world does without

        env = Maze3D()
    env.reset(seed=seed)
    maze: Maze = env.maze
    env.close()
    return maze


def _stamp_ns(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _poses(messages: dict[int, bytes]) -> dict[int, Poses]:
    """Poses of serialised odometry by stamp: read at the end, so that the run does not wait for it."""
    return {stamp: _xyyaw(deserialize_message(cdr, Odometry).pose.pose) for stamp, cdr in messages.items()}


def _xyyaw(pose: Pose) -> Poses:
    """(3,) x, y, yaw of a planar pose."""
    return np.array([pose.position.x, pose.position.y, 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)])
