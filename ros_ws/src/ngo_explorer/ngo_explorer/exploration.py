"""One exploration: the map so far, the goal now, and when nothing is left. No clock and no ROS: times are given."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ngo_explorer.boundary import Boundary
from ngo_explorer.frontiers import Candidate, Frontier, FrontierFinder, viewpoint
from ngo_explorer.known_map import Floats, KnownMap
from ngo_explorer.planner import cost_field, plan_path
from ngo_explorer.put_aside import PutAside
from ngo_explorer.rules import Situation, make_rule
from ngo_explorer.settings import ExplorerConfig

_SAME_GOAL_M = 1.0  # a frontier that moves less than this from one decision to the next is the same
_TRAIL_M = 1.0
_PROGRESS_M = 0.2
_OFF_PATH_M = 0.7
_DETOUR_M = 1.0  # a new path to the same place that is longer by this is another one, with progress of its own
_EXPLORE_LITE = (0.75, 30.0, 1.0 / 0.15)  # its smallest frontier, time without progress and time between decisions


@dataclass(frozen=True, eq=False)
class Goal:
    """Where to drive: ``pose_xyyaw`` ``(3,)``, along ``path`` ``(n, 2)``.

    candidate: what is to be seen; None: nothing new, as at home.
    """

    pose_xyyaw: Floats
    path: Floats
    candidate: Candidate | None


@dataclass(frozen=True, eq=False)
class Left:
    """A frontier that was not visited: where, and why."""

    point_xy: Floats
    reason: str


class Exploration:
    """Chooses goals while the map grows.

    Its owner gives it maps (``known``), asks ``decide`` where to drive, and says how that went: ``arrived`` or
    ``failed``. ``candidates`` and ``unreachable`` are the frontiers of the last decision that count.
    """

    def __init__(self, config: ExplorerConfig, boundary: Floats | None = None, seed: int = 0) -> None:
        """boundary: ``(n, 2)`` corners of a polygon in the map's frame, outside of which nothing is explored."""
        self._lite = config.rule == "explore_lite"
        if self._lite:
            least, progress, again = _EXPLORE_LITE
            config = replace(config, frontier_m=least, progress_s=progress, replan_s=again)
        self.config = config
        self.known = KnownMap(config.radius_m, config.comfort_m)
        self.goal: Goal | None = None
        self.candidates: Sequence[Candidate] = ()
        self.unreachable: Sequence[Left] = ()
        self._boundary = Boundary(boundary)
        self._finder = FrontierFinder(config.frontier_m, math.inf if self._lite else 2.5, by_cells=self._lite)
        self._rule = make_rule(config, np.random.default_rng(seed))
        self._aside = PutAside()
        self._may_forget = True
        self._trail: list[Floats] = []
        self._robot_xy = np.full(2, np.nan)
        self._decided_s = -math.inf
        self._best_way_m, self._progress_s = math.inf, 0.0

    @property
    def need_m(self) -> float:
        """Clearance that a cell needs for the robot's middle."""
        return self.config.need_m(self.known.resolution_m)

    @property
    def area_m2(self) -> float:
        """Known area within the boundary."""
        return self._boundary.known_m2(self.known)

    def left(self) -> list[Left]:
        """All frontiers of the last decision, those that do not count, too, and why none of them was visited."""
        waiting = [Left(candidate.frontier.point_xy, "it was not visited yet") for candidate in self.candidates]
        short = [point for point in self._finder.short_xy if self._boundary.holds(point)]
        return [*waiting, *self.unreachable, *(Left(point, "it is shorter than frontier_m") for point in short)]

    def due(self, robot_xyyaw: Floats, now_s: float) -> bool:
        """Whether it is time for a decision: there is no goal, it shows nothing new any more, or time has passed."""
        self._remember(robot_xyyaw[:2])
        goal = self.goal
        if goal is None:
            return True
        if self.stands(robot_xyyaw[:2], now_s):
            self.failed(f"no progress for {self.config.progress_s:g} s")
            return True
        if self._off_path(robot_xyyaw[:2]) or now_s - self._decided_s >= self.config.replan_s:
            return True
        return goal.candidate is not None and not self._still_frontier(goal.candidate.frontier)

    def decide(self, robot_xyyaw: Floats, now_s: float) -> Goal | None:
        """Choose where to drive now; None where no frontier is left that can be reached."""
        robot = robot_xyyaw[:2]
        self._remember(robot)
        if self.goal is not None and self.goal.candidate is None:
            if self.go_to(robot_xyyaw, self.goal.pose_xyyaw, now_s) is not None:
                return self.goal
            self.goal = None
        self._decided_s = now_s
        before = self.goal.candidate if self.goal is not None else None
        field = cost_field(self.known, robot, self.need_m)
        self.candidates, self.unreachable = self._look(field)
        while self.candidates:
            present = self._present(before)
            trail = np.array([*self._trail, robot])
            seen = Situation(robot, self.candidates, present, trail)
            chosen = self._rule(seen)
            candidate = self.candidates[chosen]
            path = plan_path(self.known, field, robot, candidate.viewpoint_xy, self.need_m)
            if path is not None:
                if chosen != present:
                    self._best_way_m, self._progress_s = math.inf, now_s
                self.goal = Goal(np.array((*candidate.viewpoint_xy, candidate.yaw)), path, candidate)
                return self.goal
            self._drop(candidate, "no path is wide enough")
        self.goal = None
        return None

    def go_to(self, robot_xyyaw: Floats, pose_xyyaw: Floats, now_s: float) -> Goal | None:
        """Drive to a place, or go on to it by a new path; None where no path leads there, and the goal stays."""
        self._decided_s = now_s
        field = cost_field(self.known, robot_xyyaw[:2], self.need_m)
        path = plan_path(self.known, field, robot_xyyaw[:2], pose_xyyaw[:2], self.need_m)
        if path is None:
            return None
        way_m = len(path) * self.known.resolution_m
        if self.goal is None or self.goal.candidate is not None:
            self._best_way_m, self._progress_s = math.inf, now_s
        elif way_m > self._best_way_m + _DETOUR_M:
            self._best_way_m = way_m
        self.goal = Goal(np.array(pose_xyyaw), path, None)
        return self.goal

    def turn_to(self, pose_xyyaw: Floats, now_s: float) -> None:
        """Turn on the spot."""
        self._best_way_m, self._progress_s, self._decided_s = math.inf, now_s, now_s
        self.goal = Goal(pose_xyyaw, pose_xyyaw[None, :2], None)

    def stands(self, robot_xy: Floats, now_s: float) -> bool:
        """Whether the robot has come no nearer to its goal for too long, along the path; turns do not count."""
        assert self.goal is not None
        nearest = int(np.argmin(np.sum((self.goal.path - robot_xy) ** 2, axis=1)))
        left_m = (len(self.goal.path) - nearest) * self.known.resolution_m
        if left_m < self._best_way_m - _PROGRESS_M:
            self._best_way_m, self._progress_s = left_m, now_s
        return now_s - self._progress_s >= self.config.progress_s

    def arrived(self) -> None:
        """The robot stands at the goal, and the map has what it sees: what is still unknown stays so from there."""
        goal, self.goal = self.goal, None
        if goal is not None and goal.candidate is not None and self._still_frontier(goal.candidate.frontier):
            reason = "it was seen from a place nearby, and stays unknown"
            self._aside.add(self.known, goal.candidate.frontier, goal.candidate.viewpoint_xy, reason, again=True)

    def another_chance(self) -> bool:
        """Before the end: whether something failed only once, or was barred by what may be gone. It is tried again."""
        if self._lite:
            return False
        gone = self._may_forget and self.known.forget_marks() and len(self.unreachable) > 0
        self._may_forget = False
        return self._aside.another_chance() or gone

    def shut_off(self, robot_xy: Floats, home_xy: Floats | None) -> Floats | None:
        """Where to wait ``(3,)`` for a way that the robot has driven and that has shut since, facing it.

        None where there is none that leads to frontiers, or home where it began. Frontiers behind it have that as
        their reason.
        """
        if home_xy is not None and not (self._trail and np.hypot(*(self._trail[0] - home_xy)) < _TRAIL_M):
            home_xy = None
        places = np.array([*self._trail, robot_xy] if home_xy is None else [home_xy, *self._trail, robot_xy])
        here = self._reached(cost_field(self.known, robot_xy, self.need_m), places)
        lost = ~here & here.any() & (not self._lite)
        while lost.any():
            newest = int(np.flatnonzero(lost)[-1])
            field = cost_field(self.known, places[newest], self.need_m)
            there = self._reached(field, places)
            lost[newest], lost[there] = False, False
            if (there & here).any() or not there.any():
                continue  # it was near to something there, and no more
            behind = [candidate.frontier.point_xy.tolist() for candidate in self._look(field)[0]]
            if behind or (home_xy is not None and there[0]):
                self.unreachable = [
                    Left(left.point_xy, "the way there has shut") if left.point_xy.tolist() in behind else left
                    for left in self.unreachable
                ]
                gaps = np.hypot(*(places[here][:, None] - places[there]).transpose(2, 0, 1))
                near, far = np.unravel_index(np.argmin(gaps), gaps.shape)
                x, y = places[there][far] - places[here][near]
                return np.array((*places[here][near], math.atan2(y, x)))
        return None

    def _reached(self, field: NDArray[np.int32], points: Floats) -> NDArray[np.bool_]:
        """Which points ``(n, 2)`` paths lead to."""
        blocks = self.known.cells(points) // self.known.block
        row, column = np.clip(blocks + 1, 0, np.array(field.shape) + 1).T
        return np.asarray(np.pad(field, 1, constant_values=-1)[row, column] >= 0)

    def failed(self, reason: str) -> None:
        """The robot could not get to the goal."""
        goal, self.goal = self.goal, None
        if goal is not None and goal.candidate is not None:
            self._aside.add(self.known, goal.candidate.frontier, goal.candidate.viewpoint_xy, reason)

    def _look(self, field: NDArray[np.int32]) -> tuple[list[Candidate], list[Left]]:
        """Find the frontiers, those that can be seen and those that cannot."""
        config, known = self.config, self.known
        candidates, unreachable = list[Candidate](), list[Left]()
        for frontier in self._finder.find(known):
            if not self._boundary.holds(frontier.point_xy):
                continue
            reason = self._aside.reason(known, frontier, for_ever=self._lite)
            barred = self._aside.barred(frontier)
            place = None if reason else self._viewpoint(frontier, field, barred)
            if place is None:
                reason = reason or (
                    "it stays unknown from all places near it"
                    if len(barred)
                    else "no path leads to where it can be seen"
                )
                unreachable.append(Left(frontier.point_xy, reason))
            elif place[2] < config.gain_m2:
                unreachable.append(Left(frontier.point_xy, "it shows less of the unknown than gain_m2"))
            else:
                candidates.append(Candidate(frontier, *place))
        return candidates, unreachable

    def _viewpoint(
        self, frontier: Frontier, field: NDArray[np.int32], barred: Floats
    ) -> tuple[Floats, float, float] | None:
        config = self.config
        return viewpoint(self.known, frontier, field, self.need_m, config.reach_m, config.gain_range_m, barred)

    def _drop(self, candidate: Candidate, reason: str) -> None:
        self._aside.add(self.known, candidate.frontier, candidate.viewpoint_xy, reason)
        self.candidates = [other for other in self.candidates if other is not candidate]
        self.unreachable = [*self.unreachable, Left(candidate.frontier.point_xy, reason)]

    def _present(self, before: Candidate | None) -> int:
        """The index of the candidate that the robot drives to already, -1 where there is none."""
        if before is None:
            return -1
        gaps = [np.hypot(*(other.frontier.point_xy - before.frontier.point_xy)) for other in self.candidates]
        nearest = int(np.argmin(gaps))
        return nearest if gaps[nearest] < _SAME_GOAL_M else -1

    def _still_frontier(self, frontier: Frontier) -> bool:
        """Whether something of a frontier is one still."""
        row, column = self.known.cell(frontier.point_xy)
        reach = max(1, int(0.5 * self.config.frontier_m / self.known.resolution_m) + 2)
        part = self.known.frontier[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
        return int(np.count_nonzero(part)) * self.known.resolution_m >= 0.5 * self.config.frontier_m

    def _remember(self, robot_xy: Floats) -> None:
        """Keep the way that the robot has driven; where the map jumps, what was driven lies elsewhere in it."""
        if np.hypot(*(robot_xy - self._robot_xy)) > self.need_m:
            self._trail.clear()
        self._robot_xy = np.array(robot_xy)
        if not self._trail or np.hypot(*(self._trail[-1] - robot_xy)) >= _TRAIL_M:
            self._trail.append(np.array(robot_xy))

    def _off_path(self, robot_xy: Floats) -> bool:
        """Whether the path is elsewhere: the map has jumped, or somebody has carried the robot."""
        assert self.goal is not None
        return bool(np.sum((self.goal.path - robot_xy) ** 2, axis=1).min() > _OFF_PATH_M**2)
