"""Node that explores: an action server, a map and a pose in, goals or velocities out."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PoseStamped, Twist, Vector3
from nav_msgs.msg import Path
from ngo_msgs.action import Explore
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import Bool
from visualization_msgs.msg import MarkerArray

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import run_node
from ngo_common.settings import usage
from ngo_explorer.exploration import Exploration
from ngo_explorer.known_map import Floats
from ngo_explorer.nodes.drivers import Nav2Driver, PublishedGoals
from ngo_explorer.nodes.markers import frontier_markers, path_message, pose_message
from ngo_explorer.nodes.settings import ExploreNodeSettings
from ngo_explorer.nodes.world_input import WorldInput
from ngo_explorer.path_follower import PathFollower
from ngo_explorer.pilot import DONE, Pilot
from ngo_explorer.settings import DriveConfig, ExplorerConfig
from ngo_explorer.warm_up import warm_up

NAME = "explore"
_SUMMARY = "Explores a place: drives to the frontiers of the map until none is left that can be reached."
_SETTINGS = (ExploreNodeSettings, ExplorerConfig, DriveConfig)
_FEEDBACK_S = 0.5
_SEARCH_RPS = 0.4  # of a robot that is lost: it looks around for what it knows
_SEARCH_RAD = math.tau


class ExploreNode(Node):
    """Owns one exploration at a time, and steps it by a timer."""

    def __init__(self) -> None:
        super().__init__(NAME)
        self._settings, self._config, self._drive = (self._declared(kind) for kind in _SETTINGS)
        settings: ExploreNodeSettings = self._settings
        warm_up()
        self._input = WorldInput(self, settings)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._markers = self.create_publisher(MarkerArray, "explore/frontiers", latched)
        self._goals = self.create_publisher(PoseStamped, "explore/goal", latched)
        self._paths = self.create_publisher(Path, "explore/path", latched)
        self._velocities = self.create_publisher(Twist, settings.cmd_vel_topic, 10) if settings.drive == "own" else None
        self.create_subscription(Bool, "explore/resume", self._on_resume, 10)
        self._driver = self._make_driver(settings)
        self._pilot: Pilot | None = None
        self._goal_handle: ServerGoalHandle | None = None
        self._active = self._paused = False
        self._server = ActionServer(
            self,
            Explore,
            "explore",
            self._execute,
            goal_callback=self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self.create_timer(1.0 / settings.control_rate, self._step)
        if settings.autostart:
            self._begin(Explore.Goal())
        self.get_logger().info(f"ready: {self.get_fully_qualified_name()}, drive {settings.drive}")

    def _declared(self, settings_type: Any) -> Any:
        live = LiveSettings(self, settings_type, beside=_SETTINGS)
        live.lock()
        return live.values

    def _make_driver(self, settings: ExploreNodeSettings) -> PathFollower | Nav2Driver | PublishedGoals:
        if settings.drive == "own":
            return PathFollower(self._drive, self._config)
        if settings.drive == "nav2":
            return Nav2Driver(self, settings.navigate_action, settings.nav2_timeout_s, self._pose_message)
        return PublishedGoals()

    def destroy_node(self) -> None:
        """Stop the robot first."""
        self._halt()
        self._server.destroy()
        super().destroy_node()

    # The action.

    def _on_goal(self, goal: Explore.Goal) -> GoalResponse:
        try:
            if self._goal_handle is not None:
                raise ValueError("an exploration is under way; cancel it first")
            if goal.mode not in ("", Explore.Goal.FAST, Explore.Goal.ACCURATE):
                raise ValueError(f"mode is '{goal.mode}'; expected 'fast' or 'accurate'")
            Exploration(self._config, _boundary(goal))
        except ValueError as error:
            self.get_logger().warning(f"goal refused: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    async def _execute(self, handle: ServerGoalHandle) -> Explore.Result:
        self._goal_handle = handle
        self._begin(handle.request)
        result: Explore.Result = await self._ended
        self._goal_handle = None
        if result.ended == Explore.Result.CANCELED:
            handle.canceled()
        elif result.ended == Explore.Result.LOST:
            handle.abort()
        else:
            handle.succeed()
        return result

    def _begin(self, goal: Explore.Goal) -> None:
        """Start an exploration; one that nobody asked for by an action ends for it."""
        self._ended: Future = Future()
        self._request = goal
        self._renew()
        self._home: Floats | None = None
        self._active, self._paused = True, False
        self._begun_s, self._sure_s = self._now_s(), time.monotonic()
        self._last_xy: Floats | None = None
        self._path_m = self._turned_rad = 0.0
        self._told_s = -math.inf

    def _renew(self) -> None:
        self._exploration, self._pilot = Exploration(self._config, _boundary(self._request)), None

    def _end(self, why: str) -> None:
        self._halt()
        exploration = self._exploration
        result = Explore.Result(ended=why, area=exploration.area_m2, path_length=self._path_m)
        for left in exploration.left():
            result.unreachable.append(Point(x=float(left.point_xy[0]), y=float(left.point_xy[1])))
            result.reasons.append(left.reason)
        self._active = False
        exploration.goal = None
        stamp = self.get_clock().now().to_msg()
        self._markers.publish(frontier_markers(exploration, self._frame, stamp))
        self._paths.publish(path_message(np.zeros((0, 2)), self._frame, stamp))
        self.get_logger().info(
            f"exploration ended: {why}; {result.area:.1f} m^2 known, path of {self._path_m:.1f} m, "
            f"{len(result.reasons)} frontiers left"
        )
        for reason, count in Counter(result.reasons).most_common():
            self.get_logger().info(f"left {count} x: {reason}")
        self._ended.set_result(result)

    # Stepping.

    def _step(self) -> None:
        if not self._active:
            return
        if self._goal_handle is not None and self._goal_handle.is_cancel_requested:
            self._end(Explore.Result.CANCELED)
            return
        if self._paused:
            self._halt()
            return
        pose, doubt = self._input.pose_xyyaw, self._input.doubt
        if doubt or pose is None or not self._input.has_map:
            self._doubtful(doubt or "there is no map", pose)
            return
        self._sure_s, self._turned_rad = time.monotonic(), 0.0
        self._count_path(pose)
        self._explore(pose)

    def _explore(self, pose: Floats) -> None:
        now_s, exploration = self._now_s(), self._exploration
        try:
            self._input.give_map(exploration.known)
        except ValueError as error:
            self.get_logger().warning(f"the map begins anew: {error}", throttle_duration_sec=5.0)
            self._halt()
            self._renew()
            return
        if self._request.return_to_start and self._home is None:
            self._home = pose
        if self._pilot is None:
            self._pilot = Pilot(exploration, self._driver, self._settings.settle_s, self._home)
        limit_s = self._request.time_limit.sec + 1e-9 * self._request.time_limit.nanosec
        if 0.0 < limit_s <= now_s - self._begun_s:
            self._end(Explore.Result.TIME_LIMIT)
            return
        if isinstance(self._driver, Nav2Driver):
            self._driver.check()
        elif isinstance(self._driver, PublishedGoals):
            self._driver.look(pose)
        decided = self._pilot.decided
        self._pilot.step(pose, now_s)
        if self._pilot.decided > decided or time.monotonic() - self._told_s > _FEEDBACK_S:
            self._tell()
        if self._pilot.state == DONE:
            self._end(Explore.Result.COMPLETE)
        elif isinstance(self._driver, PathFollower):
            if (hits := self._input.new_hits(now_s)) is not None:
                self._driver.look(*hits)
            speed, turn_rate = self._driver.step(exploration.known, pose, now_s, self._input.late_s(now_s))
            self._send_velocity(speed, turn_rate)

    def _doubtful(self, doubt: str, pose: Floats | None) -> None:
        """A robot in doubt goes nowhere: where it sees, it turns once, to find what it knows, and waits."""
        self.get_logger().warning(f"the robot waits: {doubt}", throttle_duration_sec=5.0)
        self._halt()
        if time.monotonic() - self._sure_s > self._settings.lost_timeout_s:
            self._end(Explore.Result.LOST)
        elif pose is not None and self._input.has_map and self._input.sees and self._turned_rad < _SEARCH_RAD:
            self._turned_rad += _SEARCH_RPS / self._settings.control_rate
            self._send_velocity(0.0, _SEARCH_RPS)

    def _halt(self) -> None:
        """Stop the robot; what it does afterwards is decided anew."""
        self._driver.stop()
        if self._pilot is not None:
            self._pilot.halted()
        self._send_velocity(0.0, 0.0)

    def _send_velocity(self, speed: float, turn_rate: float) -> None:
        if self._velocities is not None:
            self._velocities.publish(Twist(linear=Vector3(x=speed), angular=Vector3(z=turn_rate)))

    def _count_path(self, pose: Floats) -> None:
        if self._last_xy is not None:
            self._path_m += float(np.hypot(*(pose[:2] - self._last_xy)))
        self._last_xy = pose[:2].copy()

    def _tell(self) -> None:
        """Publish frontiers, goal and path, and the action's feedback."""
        self._told_s = time.monotonic()
        exploration, stamp = self._exploration, self.get_clock().now().to_msg()
        self._markers.publish(frontier_markers(exploration, self._frame, stamp))
        feedback = Explore.Feedback(area=exploration.area_m2, frontiers=len(exploration.candidates))
        feedback.deviation = self._input.deviation_m
        if exploration.goal is not None:
            feedback.goal = pose_message(exploration.goal.pose_xyyaw, self._frame, stamp)
            self._goals.publish(feedback.goal)
            self._paths.publish(path_message(exploration.goal.path, self._frame, stamp))
            if self._pilot is not None and (left_s := self._pilot.wait_left_s) is not None:
                feedback.frontiers += len(exploration.unreachable)
                x, y = exploration.goal.pose_xyyaw[:2]
                said = f"the robot waits at ({x:.1f}, {y:.1f}) for a way that has shut, up to {left_s:.0f} s more"
                self.get_logger().warning(said, throttle_duration_sec=30.0)
        if self._goal_handle is not None:
            self._goal_handle.publish_feedback(feedback)

    def _on_resume(self, message: Bool) -> None:
        """As explore_lite: false pauses, true goes on, or begins where nothing is under way."""
        if message.data and not self._active:
            self._begin(Explore.Goal())
        self._paused = not message.data

    @property
    def _frame(self) -> str:
        return self._settings.framed(self._settings.map_frame)

    def _pose_message(self, pose_xyyaw: Floats) -> PoseStamped:
        return pose_message(pose_xyyaw, self._frame, self.get_clock().now().to_msg())

    def _now_s(self) -> float:
        return 1e-9 * float(self.get_clock().now().nanoseconds)


def _boundary(goal: Explore.Goal) -> Floats | None:
    points = goal.boundary.points
    return np.array([(point.x, point.y) for point in points], np.float64) if points else None


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, ExploreNode, usage("ngo_explorer", NAME, _SUMMARY, *_SETTINGS)))


if __name__ == "__main__":
    main()
