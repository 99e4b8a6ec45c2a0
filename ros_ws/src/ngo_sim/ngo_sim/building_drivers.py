"""Drivers of a robot in a building: they wander or patrol, stand, turn on the spot, and speed up and brake smoothly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from ngo_common.settings import Settings, setting
from ngo_sim.convex_shapes import Floats
from ngo_sim.routes import CELL_M, RouteMap

DRIVERS = ("any", "wander", "patrol", "cmd_vel")
_LOOKAHEAD_M = (0.35, 0.9)  # at rest and at 1 m/s
_ARRIVED_M = 0.15
TURN_RPS2 = 4.0
_PATROL_ROOMS = (3, 8)


@dataclass(frozen=True)
class BuildingDriverConfig(Settings):
    """Who drives and how."""

    driver: str = setting(
        "any",
        "Who drives. wander: to random rooms; patrol: a fixed tour of rooms; any: one of these, drawn from the seed; "
        "cmd_vel: whoever publishes velocities.",
        choices=DRIVERS,
    )
    radius_m: float = setting(0.22, "Radius of the robot, m.", minimum=0.05, maximum=0.3)
    speed_mps: float = setting(0.7, "Highest speed, m/s.", minimum=0.05, maximum=2.0)
    turn_rate_rps: float = setting(1.2, "Highest turn rate, rad/s.", minimum=0.1, maximum=3.0)
    acceleration_mps2: float = setting(0.7, "Highest acceleration, m/s^2.", minimum=0.1, maximum=3.0)
    stand: float = setting(
        0.3, "Probability of a stop at a goal. Most stops last seconds, a few last minutes.", minimum=0.0, maximum=1.0
    )
    spin: float = setting(0.25, "Probability of a turn on the spot at a goal.", minimum=0.0, maximum=1.0)
    cmd_vel_timeout_s: float = setting(
        0.5, "Simulated time after the last cmd_vel after which the robot stops.", minimum=0.05, maximum=10.0
    )


class BuildingDriver:
    """Moves a disc through a building, one period after the other, never into an obstacle.

    pose_xyyaw: (3,) where it is. twist: (2,) speed in m/s and turn rate in rad/s of the last period.
    """

    def __init__(
        self, routes: RouteMap, config: BuildingDriverConfig, period_s: float, rng: np.random.Generator
    ) -> None:
        self.config, self._routes, self._period_s, self._rng = config, routes, period_s, rng
        goals = routes.goals_m
        if len(goals) < 2:
            raise ValueError(f"the building has {len(goals)} goals that can be reached; it must have two or more")
        patrols = config.driver == "patrol" or (config.driver == "any" and rng.random() < 0.5)
        count = min(len(goals), int(rng.integers(*_PATROL_ROOMS)))
        self._tour = goals[rng.choice(len(goals), count, replace=False)] if patrols else goals
        self._patrols, self._next = patrols, 0
        start = routes.path(self._tour[-1], self._tour[-1])[0]
        self.pose_xyyaw = np.array((*start, rng.uniform(-math.pi, math.pi)))
        self.twist = np.zeros(2)
        self._path = np.zeros((0, 2))
        self._along = 0
        self._stand_s, self._spin_rad = float(rng.uniform(0.0, 2.0)), 0.0

    def advance(self) -> Floats:
        """(2,) speed and turn rate with which the robot drives for one period; pose_xyyaw is then at its end."""
        config, wanted = self.config, np.zeros(2)
        if self._stand_s <= 0.0 and self._spin_rad == 0.0 and self._along >= len(self._path):
            self._choose_goal()
        if self._stand_s > 0.0 and not self.twist.any():
            self._stand_s -= self._period_s
        elif self._stand_s <= 0.0 and self._spin_rad != 0.0:
            wanted[1] = self._spin()
        elif self._along < len(self._path):
            self._along = _follow(
                self._path,
                self._along,
                self.pose_xyyaw,
                self.twist,
                self._routes.safe,
                self._period_s,
                config.speed_mps,
                config.turn_rate_rps,
                config.acceleration_mps2,
                wanted,
            )
            if self._along >= len(self._path):
                self._arrive()
        self.twist = wanted
        self.pose_xyyaw = arc_end(self.pose_xyyaw, wanted[0], wanted[1], self._period_s)
        return wanted

    def _spin(self) -> float:
        """The turn rate that takes what is left of a turn on the spot, at no more than 3 rad/s^2."""
        left = self._spin_rad
        rate = min(self.config.turn_rate_rps, abs(self.twist[1]) + 3.0 * self._period_s, math.sqrt(6.0 * abs(left)))
        rate = math.copysign(min(rate, abs(left) / self._period_s), left)
        turned = rate * self._period_s
        self._spin_rad = 0.0 if abs(left - turned) < 1e-3 else left - turned
        return rate

    def _choose_goal(self) -> None:
        for _ in range(20):
            if self._patrols:
                goal, self._next = self._tour[self._next], (self._next + 1) % len(self._tour)
            else:
                goal = self._tour[int(self._rng.integers(len(self._tour)))]
            path = self._routes.path(self.pose_xyyaw[:2], goal)
            if len(path) > 10:
                self._path, self._along = path, 0
                return

    def _arrive(self) -> None:
        rng = self._rng
        if rng.random() < self.config.stand:
            # Most stops are short; some last for minutes.
            self._stand_s = float(rng.uniform(20.0, 150.0) if rng.random() < 0.15 else rng.uniform(0.5, 8.0))
        if rng.random() < self.config.spin:
            self._spin_rad = float(rng.uniform(0.5, 2.0) * math.pi * rng.choice((-1.0, 1.0)))


def arc_end(pose_xyyaw: Floats, speed: float, turn_rate: float, time_s: float) -> Floats:
    """(3,) the pose after driving an arc of constant speed and turn rate; yaw in [-pi, pi)."""
    x, y, yaw = pose_xyyaw
    turn, chord = turn_rate * time_s, speed * time_s
    if abs(turn) > 1e-9:
        chord *= math.sin(turn / 2) / (turn / 2)
    return np.array(
        (
            x + chord * math.cos(yaw + turn / 2),
            y + chord * math.sin(yaw + turn / 2),
            (yaw + turn + math.pi) % math.tau - math.pi,
        )
    )


@njit(cache=True)
def _is_safe(safe: npt.NDArray[np.bool_], x: float, y: float) -> bool:
    return bool(safe[int(y / CELL_M), int(x / CELL_M)])


@njit(cache=True)
def _line_is_safe(safe: npt.NDArray[np.bool_], x0: float, y0: float, x1: float, y1: float) -> bool:
    steps = int(np.hypot(x1 - x0, y1 - y0) / 0.04) + 1
    for step in range(1, steps + 1):
        share = step / steps
        if not _is_safe(safe, x0 + share * (x1 - x0), y0 + share * (y1 - y0)):
            return False
    return True


@njit(cache=True)
def _follow(
    path: Floats,
    along: int,
    pose: Floats,
    twist: Floats,
    safe: npt.NDArray[np.bool_],
    period: float,
    top_speed: float,
    top_rate: float,
    acceleration: float,
    wanted: Floats,
) -> int:
    """Pure pursuit: fills wanted with speed and turn rate; returns how far along the path the robot is.

    The target is a point that a straight line through safe cells leads to. Where the arc to it is not safe, the robot
    turns on the spot: the line is.
    """
    x, y, yaw = pose
    nearest, best = along, np.inf
    for index in range(along, min(along + 40, len(path))):
        gap = (path[index, 0] - x) ** 2 + (path[index, 1] - y) ** 2
        if gap < best:
            nearest, best = index, gap
    end_gap = np.hypot(path[-1, 0] - x, path[-1, 1] - y)
    if (end_gap < _ARRIVED_M or nearest == len(path) - 1) and twist[0] <= acceleration * period:
        return len(path)
    reach = _LOOKAHEAD_M[0] + (_LOOKAHEAD_M[1] - _LOOKAHEAD_M[0]) * min(1.0, twist[0])
    target = nearest
    while target < len(path) - 1 and np.hypot(path[target, 0] - x, path[target, 1] - y) < reach:
        target += 1
    while target > nearest and not _line_is_safe(safe, x, y, path[target, 0], path[target, 1]):
        target -= 1
    dx, dy = path[target, 0] - x, path[target, 1] - y
    bearing = (np.arctan2(dy, dx) - yaw + np.pi) % (2 * np.pi) - np.pi
    speed = 0.0
    if abs(bearing) < 0.9:
        # Slower in curves and before the end, at a speed that it can brake from.
        curvature = 2.0 * np.sin(bearing) / max(np.hypot(dx, dy), 0.05)
        speed = min(top_speed, np.sqrt(2.0 * acceleration * max(end_gap - 0.1, 0.0)) + 0.03)
        speed = min(speed, top_rate / max(abs(curvature), 1e-6)) * max(0.2, 1.0 - 0.9 * abs(bearing))
        rate = speed * curvature
    else:
        rate = np.sign(bearing) * min(top_rate, 2.5 * abs(bearing))
    speed = min(max(speed, twist[0] - acceleration * period), twist[0] + acceleration * period)
    rate = min(max(rate, twist[1] - TURN_RPS2 * period), twist[1] + TURN_RPS2 * period)
    rate = min(max(rate, -top_rate), top_rate)
    for part in (0.25, 0.5, 0.75, 1.0):
        turn = rate * period * part
        chord = speed * period * part
        if not _is_safe(safe, x + chord * np.cos(yaw + turn / 2), y + chord * np.sin(yaw + turn / 2)):
            speed = 0.0
            rate = np.sign(bearing) * min(top_rate, 2.5 * abs(bearing))
            if abs(bearing) < 0.02 and target > nearest:
                speed = min(0.1, np.hypot(dx, dy) / period)
                rate = 0.0
            break
    wanted[0], wanted[1] = speed, rate
    return nearest
