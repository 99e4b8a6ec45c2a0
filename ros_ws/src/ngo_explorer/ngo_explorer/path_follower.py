"""Follows a path with limited speed and acceleration, turns to the goal's direction, and backs up where it is stuck."""

from __future__ import annotations

import math

import numpy as np

from ngo_explorer.known_map import Floats, KnownMap
from ngo_explorer.planner import line_is_free
from ngo_explorer.settings import DriveConfig, ExplorerConfig

_LOOKAHEAD_M = (0.35, 0.8)  # at rest and at 1 m/s
_TURN_ON_THE_SPOT_RAD = 0.8
_FACES_RAD = 0.3  # near enough to the goal's direction
_BACK_M, _BACK_MPS = 0.3, 0.1
_MOVED_M, _MOVED_RAD = 0.03, 0.1
_SPARE_M = 0.3  # beyond the way until the robot could stop, up to which hits of a scan are kept
_KEPT_S = 2.0  # poses come no later than this
_MOST_TRIES = 3  # to come free, before the goal is given up

DRIVING, ARRIVED, STUCK = "driving", "arrived", "stuck"


class PathFollower:
    """Turns a path, the robot's pose and the newest map into velocities.

    ``state`` is DRIVING, ARRIVED at the goal, or STUCK: it backed up several times in vain.
    """

    def __init__(self, config: DriveConfig, robot: ExplorerConfig) -> None:
        """robot: how near its middle may come to what the map has, and to what its newest scan shows."""
        self.config, self._robot, self._touch_m, self._need_m = config, robot, robot.touch_m, 0.0
        self._seen_m = self._touch_m + config.speed_mps * self._stop_s(config.speed_mps) + _SPARE_M
        self.state = ARRIVED
        self._path, self._goal_yaw = np.zeros((0, 2)), 0.0
        self._speed = self._turn_rate = 0.0
        self._along = 0
        self._tries, self._back_left_m = 0, 0.0
        self._moved_at: tuple[Floats, float] | None = None
        self._last_s: float | None = None
        self._hits, self._hits_s = np.zeros((0, 2)), math.inf
        self._sent: list[tuple[float, float, float]] = []  # times, speeds and turn rates, those of the last seconds

    def follow(self, path: Floats, yaw: float, new: bool = True) -> None:
        """Drive along ``path`` ``(n, 2)``, and look along ``yaw`` at its end; ``new``: not the goal of before."""
        self._path, self._goal_yaw, self._along, self.state = path, yaw, 0, DRIVING
        if new:
            self._tries, self._moved_at = 0, None

    def stop(self) -> None:
        """Give the path up; the robot brakes. What moves it until the next step is not known."""
        self._path, self.state, self._sent = np.zeros((0, 2)), ARRIVED, []
        self._speed = self._turn_rate = self._back_left_m = 0.0
        self._last_s = None

    def look(self, hits_xy: Floats, seen_s: float) -> None:
        """Take the hits ``(n, 2)`` of the newest scan, in the robot's frame when it was taken.

        The map may lack what they show: panes that most rays pass through, people, doors that were open.
        """
        away_m = np.hypot(*hits_xy.T)
        # What is far inside the robot is the robot itself.
        self._hits, self._hits_s = hits_xy[(away_m > 0.8 * self._touch_m) & (away_m < self._seen_m)], seen_s

    def step(self, known: KnownMap, robot_xyyaw: Floats, now_s: float, late_s: float = 0.0) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) from now on; call it at a steady pace.

        robot_xyyaw: where the robot was ``late_s`` ago. Since then it has moved as it was told.
        """
        self._need_m = self._robot.need_m(known.resolution_m)
        robot_xyyaw = self._moved_on(robot_xyyaw, now_s - late_s, now_s)
        period_s = 0.0 if self._last_s is None else min(0.5, max(0.0, now_s - self._last_s))
        self._last_s = now_s
        speed, turn_rate = 0.0, 0.0
        if self.state == DRIVING:
            speed, turn_rate = self._wanted(known, robot_xyyaw, now_s, period_s)
        config = self.config
        change = config.acceleration_mps2 * period_s
        # Braking is not limited: the base does that, and a softer stop would run into what is ahead.
        self._speed = speed if abs(speed) < abs(self._speed) else _towards(speed, self._speed, change)
        if self._speed and self._would_touch(now_s):
            self._speed = 0.0
            known.mark(_placed(robot_xyyaw, self._hits_now(now_s)))
        turning = config.turn_acceleration_rps2 * period_s
        self._turn_rate = turn_rate if turn_rate == 0.0 else _towards(turn_rate, self._turn_rate, turning)
        self._sent = [sent for sent in self._sent if sent[0] > min(now_s, self._hits_s) - _KEPT_S]
        self._sent.append((now_s, self._speed, self._turn_rate))
        return self._speed, self._turn_rate

    def _moved_on(self, robot: Floats, since_s: float, now_s: float) -> Floats:
        """A pose, carried on by what was sent: one arc a command."""
        x, y, yaw = robot.tolist()
        ends_s = [*(sent[0] for sent in self._sent[1:]), now_s]
        for (begin_s, speed, turn_rate), end_s in zip(self._sent, ends_s, strict=False):
            lasting_s = max(0.0, end_s - max(begin_s, since_s))
            way, half = speed * lasting_s, 0.5 * turn_rate * lasting_s
            way *= math.sin(half) / half if half else 1.0
            x, y, yaw = x + way * math.cos(yaw + half), y + way * math.sin(yaw + half), yaw + 2.0 * half
        return np.array((x, y, yaw))

    def _wanted(self, known: KnownMap, robot: Floats, now_s: float, period_s: float) -> tuple[float, float]:
        if self._back_left_m > 0.0:
            return self._back(known, robot, period_s)
        gaps = np.hypot(*(self._path[self._along :] - robot[:2]).T)
        self._along += int(np.argmin(gaps[:200]))
        end_gap = float(np.hypot(*(self._path[-1] - robot[:2])))
        if end_gap < self.config.arrived_m:
            return self._face(robot)
        if self._is_stuck(robot, now_s):
            return self._back(known, robot, period_s) if self._back_left_m > 0.0 else (0.0, 0.0)
        target = self._target(known, robot)
        if target is None:
            return 0.0, 0.0
        return self._pursue(known, robot, target, end_gap)

    def _target(self, known: KnownMap, robot: Floats) -> Floats | None:
        """The farthest point within the look ahead that a straight free line leads to; None where there is none."""
        low, high = _LOOKAHEAD_M
        reach = low + (high - low) * min(1.0, self._speed)
        ahead = self._path[self._along :]
        count = int(np.searchsorted(np.cumsum(np.hypot(*np.diff(ahead, axis=0).T)), reach)) + 1
        row, column = known.cell(robot)
        inside = 0 <= row < known.state.shape[0] and 0 <= column < known.state.shape[1]
        # Where it stands too near to something already, it may go on as long as it comes no nearer.
        need = min(self._need_m, float(known.clearance_m[row, column]) - known.resolution_m) if inside else self._need_m
        for index in range(min(count, len(ahead) - 1), -1, -max(1, count // 8)):
            if line_is_free(known, robot, ahead[index], need):
                return np.asarray(ahead[index])
        return None

    def _pursue(self, known: KnownMap, robot: Floats, target: Floats, end_gap: float) -> tuple[float, float]:
        config = self.config
        dx, dy = target - robot[:2]
        bearing = math.remainder(math.atan2(dy, dx) - robot[2], math.tau)
        if abs(bearing) > _TURN_ON_THE_SPOT_RAD:
            return 0.0, math.copysign(min(config.turn_rate_rps, 2.5 * abs(bearing)), bearing)
        curvature = 2.0 * math.sin(bearing) / max(math.hypot(dx, dy), 0.1)
        speed = min(config.speed_mps, math.sqrt(2.0 * config.acceleration_mps2 * max(end_gap - 0.05, 0.0)) + 0.05)
        speed = min(speed, config.turn_rate_rps / max(abs(curvature), 1e-6)) * max(0.25, 1.0 - abs(bearing))
        if not self._arc_is_free(known, robot, speed, speed * curvature):
            # The line to the target is free, so turn until it is what lies ahead.
            if abs(bearing) > 0.05:
                return 0.0, math.copysign(min(config.turn_rate_rps, max(0.2, 2.5 * abs(bearing))), bearing)
            return min(0.15, speed), speed * curvature
        return speed, speed * curvature

    def _arc_is_free(self, known: KnownMap, robot: Floats, speed: float, turn_rate: float) -> bool:
        """Whether the way until it could stop is free, half a second on."""
        need, before = self._need_m - 0.5 * known.resolution_m, robot
        for there in _placed(robot, self._ahead(speed, turn_rate)):
            if not line_is_free(known, before, there, need):
                return False
            before = there
        return True

    def _ahead(self, speed: float, turn_rate: float) -> Floats:
        """Points ``(n, 2)`` of the way until it could stop, half a second on, in the robot's frame."""
        stop_s = self._stop_s(speed)
        # No farther apart than what the robot sweeps at each of them.
        count = max(4, math.ceil(abs(speed) * stop_s / self._touch_m))
        times = stop_s * np.arange(1, count + 1) / count
        headings = turn_rate * times / 2
        return np.column_stack((speed * times * np.cos(headings), speed * times * np.sin(headings)))

    def _stop_s(self, speed: float) -> float:
        return 0.5 + abs(speed) / (2.0 * self.config.acceleration_mps2)

    def _would_touch(self, now_s: float) -> bool:
        """Whether the way until it could stop comes nearer to two hits of the newest scan; one alone may be noise."""
        hits = self._hits_now(now_s)
        if len(hits) < 2:
            return False
        way = np.vstack((np.zeros(2), self._ahead(self._speed, self._turn_rate)))
        gaps = np.partition(np.hypot(*(hits - way[:, None]).transpose(2, 0, 1)), 1, axis=1)[:, 1]
        return bool(np.any(gaps[1:] < min(self._touch_m, gaps[0] - 0.01)))

    def _hits_now(self, now_s: float) -> Floats:
        """The hits in the robot's frame of now: it has moved on."""
        moved = self._moved_on(np.zeros(3), self._hits_s, now_s)
        cos, sin = math.cos(moved[2]), math.sin(moved[2])
        return np.asarray((self._hits - moved[:2]) @ np.array(((cos, -sin), (sin, cos))))

    def _face(self, robot: Floats) -> tuple[float, float]:
        off = math.remainder(self._goal_yaw - robot[2], math.tau)
        if abs(off) < _FACES_RAD:
            self.state = ARRIVED
            return 0.0, 0.0
        return 0.0, math.copysign(min(self.config.turn_rate_rps, 2.5 * abs(off)), off)

    def _is_stuck(self, robot: Floats, now_s: float) -> bool:
        if self._moved_at is not None:
            pose, since_s = self._moved_at
            moved = float(np.hypot(*(pose[:2] - robot[:2])))
            turned = abs(math.remainder(pose[2] - robot[2], math.tau))
            if moved < _MOVED_M and turned < _MOVED_RAD:
                if now_s - since_s < self.config.stuck_s:
                    return False
                self._tries += 1
                self._back_left_m, self._moved_at = _BACK_M, None
                if self._tries >= _MOST_TRIES:
                    self._back_left_m, self.state = 0.0, STUCK
                return True
        self._moved_at = np.array(robot), now_s
        return False

    def _back(self, known: KnownMap, robot: Floats, period_s: float) -> tuple[float, float]:
        """Back up as far as what is known to be free lets it."""
        x, y, yaw = robot.tolist()
        behind = np.array((x - 0.15 * math.cos(yaw), y - 0.15 * math.sin(yaw)))
        self._back_left_m -= max(_BACK_MPS * period_s, 1e-3)
        if not line_is_free(known, robot, behind, self._need_m - 2.0 * known.resolution_m):
            self._back_left_m = 0.0
            return 0.0, 0.0
        return -_BACK_MPS, 0.0


def _placed(pose: Floats, points: Floats) -> Floats:
    """Points ``(n, 2)`` seen from a pose ``(3,)``, in its frame."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.asarray(pose[:2] + points @ np.array(((cos, sin), (-sin, cos))))


def _towards(wanted: float, now: float, change: float) -> float:
    return min(max(wanted, now - change), now + change)
