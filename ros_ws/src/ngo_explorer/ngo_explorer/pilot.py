"""Explores from the first decision to the end: decisions in their turn, what became of goals, the way home."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from ngo_explorer.exploration import Exploration, Goal
from ngo_explorer.known_map import Floats
from ngo_explorer.path_follower import ARRIVED, STUCK

_LOOKS = 3  # directions, to see all around

EXPLORING, RETURNING, DONE = "exploring", "returning", "done"


class Driver(Protocol):
    """Who drives to goals: the path follower, Nav2, or somebody else. ``state`` is one of the path follower's."""

    state: str

    def follow(self, path: Floats, yaw: float, new: bool) -> None:
        """Drive along a path; ``new`` says whether it leads to another goal than the last one."""
        ...

    def stop(self) -> None:
        """Stop, and forget the path."""
        ...


class Pilot:
    """Calls an exploration's decisions in time, and hands its goals to a driver.

    ``state`` is EXPLORING, RETURNING or DONE. ``decided`` counts decisions. Stamps may be of any clock.
    """

    def __init__(self, exploration: Exploration, driver: Driver, settle_s: float, home_xyyaw: Floats | None) -> None:
        """settle_s: longest time that a map needs until it holds what is seen now. home_xyyaw: where to return to."""
        self.exploration, self.state, self.decided = exploration, EXPLORING, 0
        self._driver, self._settle_s, self._home = driver, settle_s, home_xyyaw
        self._looks_left = _LOOKS
        self._waits: tuple[float, int] | None = None  # since when the robot waits for the map, and the map then

    def step(self, robot_xyyaw: Floats, now_s: float) -> Goal | None:
        """Decide what is to be decided now; returns the present goal."""
        exploration = self.exploration
        if self.state == DONE or exploration.known.empty:
            return None
        if exploration.goal is not None and self._driver.state == STUCK:
            exploration.failed("the robot did not get there")
        elif exploration.goal is not None and self._driver.state == ARRIVED and self._settled(now_s):
            self._waits = None
            exploration.arrived()
        elif exploration.goal is not None and self._driver.state == ARRIVED and exploration.goal.candidate is None:
            exploration.arrived()
        if self.state == RETURNING:
            if exploration.goal is None:
                self._end()
        elif exploration.due(robot_xyyaw, now_s):
            self._decide(robot_xyyaw, now_s)
        return exploration.goal

    def _decide(self, robot_xyyaw: Floats, now_s: float) -> None:
        before, self.decided = self.exploration.goal, self.decided + 1
        goal = self.exploration.decide(robot_xyyaw, now_s)
        if goal is None:
            self._look_or_finish(robot_xyyaw, now_s)
            return
        self._waits, self._looks_left = None, _LOOKS
        self._driver.follow(goal.path, float(goal.pose_xyyaw[2]), new=_other(before, goal))

    def _look_or_finish(self, robot_xyyaw: Floats, now_s: float) -> None:
        """Before the end the robot turns around once: the map may lack what it sees from here."""
        if self._looks_left > 0:
            self._looks_left -= 1
            pose = robot_xyyaw + (0.0, 0.0, math.tau / _LOOKS)
            self.exploration.goal = Goal(pose, pose[None, :2], None)
            self._driver.follow(pose[None, :2], float(pose[2]), new=True)
            return
        self._driver.stop()
        if self._settled(now_s) and not self.exploration.another_chance():
            self._finish(robot_xyyaw)

    def _settled(self, now_s: float) -> bool:
        changes = self.exploration.known.changes
        if self._waits is None:
            self._waits = now_s, changes
        since_s, before = self._waits
        return now_s - since_s >= self._settle_s or (changes > before and now_s - since_s >= 0.5 * self._settle_s)

    def _finish(self, robot_xyyaw: Floats) -> None:
        self.exploration.goal = None
        goal = None if self._home is None else self.exploration.go_to(robot_xyyaw, self._home)
        if goal is None:
            self._end()
            return
        self.state = RETURNING
        self._driver.follow(goal.path, float(goal.pose_xyyaw[2]), new=True)

    def _end(self) -> None:
        self.state = DONE
        self._driver.stop()


def _other(before: Goal | None, goal: Goal) -> bool:
    return before is None or bool(np.hypot(*(before.pose_xyyaw - goal.pose_xyyaw)[:2]) > 0.5)
