"""Who drives: Nav2 by its action, or somebody who takes the goals that are published."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.node import Node

from ngo_explorer.known_map import Floats
from ngo_explorer.path_follower import ARRIVED, DRIVING, STUCK

_MOVED_M = 0.3  # a goal that has moved less is not sent again
_ARRIVED_M = 0.4

ToPose = Callable[[Floats], PoseStamped]


class Nav2Driver:
    """Sends goals to `navigate_to_pose`. A goal that is refused, aborted or not answered in time ends as STUCK."""

    def __init__(self, node: Node, action: str, timeout_s: float, to_pose: ToPose) -> None:
        self.state = ARRIVED
        self._client = ActionClient(node, NavigateToPose, action)
        self._timeout_s, self._to_pose = timeout_s, to_pose
        self._number = 0
        self._sent_s = 0.0
        self._answered = True
        self._handle: Any = None
        self._pose: Floats | None = None

    def follow(self, path: Floats, yaw: float, new: bool) -> None:
        """Have Nav2 drive to the path's end."""
        pose = np.array((*path[-1], yaw))
        near = self._pose is not None and float(np.hypot(*(pose - self._pose)[:2])) < _MOVED_M
        if not new and near and self.state == DRIVING:
            return
        self._number += 1
        self._pose, self._handle, self.state = pose, None, DRIVING
        self._sent_s, self._answered = time.monotonic(), False
        if self._client.server_is_ready():
            self._send(self._number)

    def stop(self) -> None:
        """Cancel what Nav2 does for this node."""
        self._number += 1
        if self._handle is not None and self.state == DRIVING:
            self._handle.cancel_goal_async()
        self._handle, self._pose, self.state = None, None, ARRIVED

    def check(self) -> None:
        """Look whether Nav2 is there still, and whether it answers."""
        if self.state != DRIVING:
            return
        ready = self._client.server_is_ready()
        if (self._answered and not ready) or (not self._answered and time.monotonic() - self._sent_s > self._timeout_s):
            self.state = STUCK

    def _send(self, number: int) -> None:
        assert self._pose is not None
        goal = NavigateToPose.Goal(pose=self._to_pose(self._pose))
        self._client.send_goal_async(goal).add_done_callback(lambda future: self._on_answer(number, future))

    def _on_answer(self, number: int, future: Any) -> None:
        handle = future.result()
        if number != self._number:
            if handle is not None and handle.accepted:
                handle.cancel_goal_async()
            return
        self._answered = True
        if handle is None or not handle.accepted:
            self.state = STUCK
            return
        self._handle = handle
        handle.get_result_async().add_done_callback(lambda done: self._on_result(number, done))

    def _on_result(self, number: int, future: Any) -> None:
        if number == self._number:
            succeeded = future.result().status == GoalStatus.STATUS_SUCCEEDED
            self.state, self._handle = ARRIVED if succeeded else STUCK, None


class PublishedGoals:
    """Goals are published, and reached once the robot is near: somebody else drives."""

    def __init__(self) -> None:
        self.state = ARRIVED
        self._pose: Floats | None = None

    def follow(self, path: Floats, yaw: float, new: bool) -> None:
        """Wait for the robot at the path's end."""
        self._pose, self.state = np.array((*path[-1], yaw)), DRIVING

    def stop(self) -> None:
        """Wait no more."""
        self._pose, self.state = None, ARRIVED

    def look(self, robot_xyyaw: Floats) -> None:
        """Look whether the robot is there."""
        if self._pose is not None:
            away = robot_xyyaw - self._pose
            if math.hypot(away[0], away[1]) < _ARRIVED_M and abs(math.remainder(away[2], math.tau)) < 1.0:
                self.state = ARRIVED
