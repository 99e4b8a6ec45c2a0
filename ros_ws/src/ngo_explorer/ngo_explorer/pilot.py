"""Explores from the first decision to the end: decisions in their turn, what became of goals, the way home."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from ngo_explorer.exploration import Exploration, Goal, Left
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
        self._shut_s: float | None = None  # until when its wait for a way that has shut is counted; it stands there
        self._wait_left_s = exploration.config.wait_s

    def step(self, robot_xyyaw: Floats, now_s: float) -> Goal | None:
        """Decide what is to be decided now; returns the present goal."""
        exploration = self.exploration
        if self.state == DONE or exploration.known.empty:
            return None
        if self._shut_s is not None:
            self._wait_left_s, self._shut_s = self._wait_left_s - (now_s - self._shut_s), now_s
        if self.state == RETURNING:
            self._return(robot_xyyaw, now_s)
        elif exploration.goal is not None and self._driver.state == STUCK:
            exploration.failed("the robot did not get there")
        elif exploration.goal is not None and self._shut_s is None and self._seen(exploration.goal, now_s):
            self._waits = None
            exploration.arrived()
        if self.state == EXPLORING and exploration.due(robot_xyyaw, now_s):
            self._decide(robot_xyyaw, now_s)
        return exploration.goal

    @property
    def wait_left_s(self) -> float | None:
        """How long it still waits at most where a way has shut; None: it does not wait."""
        return None if self._shut_s is None else max(0.0, self._wait_left_s)

    def halted(self) -> None:
        """The robot was stopped: what it does is decided anew, and the time until then counts as no wait."""
        self.exploration.goal = self._shut_s = None

    def _decide(self, robot_xyyaw: Floats, now_s: float) -> None:
        before, self.decided = self.exploration.goal, self.decided + 1
        goal = self.exploration.decide(robot_xyyaw, now_s)
        if goal is None:
            self._look_or_finish(robot_xyyaw, now_s)
            return
        if goal.candidate is not None:
            self._waits, self._looks_left, self._shut_s = None, _LOOKS, None
        self._driver.follow(goal.path, float(goal.pose_xyyaw[2]), new=_other(before, goal))

    def _look_or_finish(self, robot_xyyaw: Floats, now_s: float) -> None:
        """Before the end the robot turns around once: the map may lack what it sees from here."""
        if self._looks_left > 0:
            self._looks_left -= 1
            pose = robot_xyyaw + (0.0, 0.0, math.tau / _LOOKS)
            self.exploration.turn_to(pose, now_s)
            self._driver.follow(pose[None, :2], float(pose[2]), new=True)
            return
        self._driver.stop()
        if self._settled(now_s) and not self.exploration.another_chance() and not self._wait(robot_xyyaw, now_s):
            self.state = RETURNING
            self._return(robot_xyyaw, now_s)

    def _wait(self, robot_xyyaw: Floats, now_s: float) -> bool:
        """Go where a way has shut, stand and look around again; False where none has, or it lasts too long."""
        place = self.exploration.shut_off(robot_xyyaw[:2], None if self._home is None else self._home[:2])
        self._shut_s = None if place is None or self._wait_left_s <= 0.0 else now_s
        if place is None or self._shut_s is None:
            return False
        if self.exploration.go_to(robot_xyyaw, place, now_s) is None:
            place = robot_xyyaw
            self.exploration.turn_to(place, now_s)
        assert self.exploration.goal is not None
        self._driver.follow(self.exploration.goal.path, float(place[2]), new=True)
        self._waits, self._looks_left = None, _LOOKS
        return True

    def _seen(self, goal: Goal, now_s: float) -> bool:
        """Whether the robot stands at a goal, and the map has what is to be seen there."""
        return self._driver.state == ARRIVED and (goal.candidate is None or self._settled(now_s))

    def _settled(self, now_s: float) -> bool:
        changes = self.exploration.known.changes
        if self._waits is None:
            self._waits = now_s, changes
        since_s, before = self._waits
        return now_s - since_s >= self._settle_s or (changes > before and now_s - since_s >= 0.5 * self._settle_s)

    def _return(self, robot_xyyaw: Floats, now_s: float) -> None:
        """Drive home, planned anew in its turn. While no path leads there the last one stays: what bars it may go."""
        exploration, home, new = self.exploration, self._home, self.exploration.goal is None
        if home is None or (not new and self._driver.state == ARRIVED):
            self._end()
        elif not new and exploration.stands(robot_xyyaw[:2], now_s):
            exploration.goal = None
            if self._wait(robot_xyyaw, now_s):
                self.state = EXPLORING
            else:
                self._end(Left(home[:2], "the robot did not get back to the start"))
        elif new or exploration.due(robot_xyyaw, now_s):
            goal = exploration.go_to(robot_xyyaw, home, now_s)
            if goal is None and exploration.known.forget_marks():
                goal = exploration.go_to(robot_xyyaw, home, now_s)
            if goal is not None:
                self._driver.follow(goal.path, float(goal.pose_xyyaw[2]), new)
            elif new:
                self._end(Left(home[:2], "no path leads back to the start"))

    def _end(self, *left: Left) -> None:
        self.state, self.exploration.goal = DONE, None
        self.exploration.unreachable = [*self.exploration.unreachable, *left]
        self._driver.stop()


def _other(before: Goal | None, goal: Goal) -> bool:
    return before is None or bool(np.hypot(*(before.pose_xyyaw - goal.pose_xyyaw)[:2]) > 0.5)
