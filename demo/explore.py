"""A robot maps an unseen building from nothing: the whole graph with the explorer, and its map beside the true one."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as RosPath
from ngo_msgs.action import Explore
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from visualization_msgs.msg import MarkerArray

from demo.explore_picture import UNDER_WAY, Grid, Pictured, UnderWay, draw, in_frame_of, under_way
from demo.graph import Graph, NodeSpec
from ngo_sim.floor_plans import FloorPlanConfig
from training.data.explored_worlds import Building
from training.scoring.exploring import Seen

_START_TIMEOUT_S = 300.0
_MOST_S = 3600.0

Show = Callable[[str, float], None]
"""Called with what is going on and the share seen so far."""


@dataclass(frozen=True)
class ExploreConfig:
    """Which building is explored: its seed, the factor on its corridors, and scans a second of wall time."""

    seed: int
    scale: float = 0.3
    rate: float = 10.0

    def nodes(self) -> list[NodeSpec]:
        """The estimators, the map and the explorer."""
        timed = {"use_sim_time": True}
        lidar = {"robot_odometry": "topic", "image_reliability": "reliable", "image_depth": 100}
        return [
            NodeSpec("ngo_estimator", "local_node", {"world": "scan", **lidar, **timed}),
            NodeSpec("ngo_estimator", "ngo_node", {"world": "scan", **timed}),
            NodeSpec("ngo_estimator", "ngo_map", {"world": "scan", "map_update_interval": 0.5, **timed}),
            NodeSpec("ngo_explorer", "explore", {"drive": "own", **timed}),
        ]

    def simulator(self) -> NodeSpec:
        """The building with the robot, whose wheels are biased."""
        wheels = {"left_bias": 0.01, "right_bias": -0.005}
        plan = {"seed": self.seed, "scale": self.scale, "people": 0, "range_max_m": 12.0, **wheels}
        waits = {"wait_for_subscribers": 1, "wait_for_flow_control": True}
        drive = {"driver": "cmd_vel", "speed_mps": 1.0, "acceleration_mps2": 1.0, "publish_clock": True}
        return NodeSpec("ngo_sim", "building2d", {**plan, **drive, **waits, "rate": self.rate})


class ExploreDemo:
    """Runs the graph until the explorer has ended; everything it leaves behind lies below out."""

    def __init__(self, config: ExploreConfig, out: Path, domain_id: int | None = None) -> None:
        """Run in a ROS domain that is free, or in ``domain_id``."""
        self._config, self._out, self._domain_id = config, out, domain_id
        self._seen = Seen(*Building(config.seed, FloorPlanConfig(scale=config.scale, people=0)).exact_scans())
        self._truth: list[np.ndarray] = []
        self._grid: Grid | None = None
        self._told: dict[type, Any] = {}  # the newest of what the explorer publishes
        self._under_way: UnderWay | None = None
        self._rows: list[tuple[float, float, float]] = []  # time, path, coverage
        self._path_m, self._collisions, self._time_s = 0.0, 0, 0.0

    def run(self, show: Show) -> dict[str, Any]:
        """Explore, write picture.png and the logs, and return the result."""
        context = Context()
        with Graph(self._out / "logs", self._domain_id) as graph:
            rclpy.init(args=[], context=context, domain_id=graph.domain_id)
            node = rclpy.create_node("explore_demo", context=context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            try:
                result = self._explore(graph, node, lambda: executor.spin_once(timeout_sec=0.1), show)
                graph.stop()
            finally:
                node.destroy_node()
                rclpy.try_shutdown(context=context)
        assert self._grid is not None
        found = Pictured(
            result, self._seen.map, np.array(self._truth), self._grid, self._under_way, np.array(self._rows)
        )
        draw(self._out / "picture.png", found)
        return result

    def _explore(self, graph: Graph, node: Any, step: Callable[[], None], show: Show) -> dict[str, Any]:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(Odometry, "ground_truth", self._on_truth, 100)
        node.create_subscription(OccupancyGrid, "map", self._on_map, latched)
        node.create_subscription(OccupancyGridUpdate, "map_updates", self._on_update, 10)
        node.create_subscription(PointStamped, "collision", self._on_collision, 10)
        for kind, name in ((MarkerArray, "frontiers"), (PoseStamped, "goal"), (RosPath, "path")):
            node.create_subscription(kind, f"explore/{name}", self._keep, latched)
        client = ActionClient(node, Explore, "explore")
        show("starting the nodes", 0.0)
        for spec in self._config.nodes():
            graph.start(spec)
        graph.wait_for(client.server_is_ready, "the explorer to come up", _START_TIMEOUT_S, step)
        graph.start(self._config.simulator())
        graph.wait_for(lambda: bool(self._truth), "the first frame", _START_TIMEOUT_S, step)
        answer = client.send_goal_async(Explore.Goal())
        graph.wait_for(answer.done, "an answer to the goal", _START_TIMEOUT_S, step)
        done = answer.result().get_result_async()

        def explored() -> bool:
            show("exploring", self._rows[-1][2] if self._rows else 0.0)
            return bool(done.done())

        graph.wait_for(explored, "the end of the exploration", _MOST_S, step)
        found = done.result().result
        return {
            "world": "explore",
            "seed": self._config.seed,
            "ended": found.ended,
            "coverage": round(self._rows[-1][2], 4),
            "path_m": round(self._path_m, 1),
            "path_to_95_m": next((round(path, 1) for _, path, seen in self._rows if seen >= 0.95), None),
            "time_s": round(self._time_s, 1),
            "area_m2": round(found.area, 1),
            "collisions": self._collisions,
            "unreachable": dict(Counter(found.reasons)),
        }

    def _on_truth(self, message: Odometry) -> None:
        pose = message.pose.pose
        yaw = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        now = np.array((pose.position.x, pose.position.y, yaw))
        if self._truth:
            self._path_m += float(np.hypot(*(now - self._truth[-1])[:2]))
        self._truth.append(now)
        self._time_s = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec

    def _keep(self, message: Any) -> None:
        self._told[type(message)] = message

    def _on_collision(self, message: PointStamped) -> None:
        self._collisions += 1

    def _on_map(self, message: OccupancyGrid) -> None:
        info = message.info
        values = np.array(message.data, np.int8).reshape(info.height, info.width)
        corner = np.array((info.origin.position.x, info.origin.position.y))
        self._grid = values, float(info.resolution), corner
        self._count()

    def _on_update(self, message: OccupancyGridUpdate) -> None:
        if self._grid is not None:
            part = np.array(message.data, np.int8).reshape(message.height, message.width)
            self._grid[0][message.y : message.y + message.height, message.x : message.x + message.width] = part
            self._count()

    def _count(self) -> None:
        """Share of the cells that can be seen which the map knows, where its first pose is the true one."""
        if not self._truth or self._grid is None:
            return
        values, resolution, corner = self._grid
        points = in_frame_of(self._seen.free_points(), self._truth[0])
        columns, rows = np.floor((points - corner) / resolution).astype(int).T
        inside = (rows >= 0) & (columns >= 0) & (rows < values.shape[0]) & (columns < values.shape[1])
        known = values[rows[inside], columns[inside]] != -1
        share = float(np.count_nonzero(known)) / len(points)
        self._rows.append((self._time_s, self._path_m, share))
        if self._under_way is None and share >= UNDER_WAY and len(self._told) == 3:
            self._under_way = under_way((values.copy(), resolution, corner), self._told)
