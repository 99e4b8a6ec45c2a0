"""A driver with a plan of the maze that drives for distance; the learned driver has its first lessons from it."""

from __future__ import annotations

import math

import numpy as np

from ngo_sim.drivers import PathDriver
from ngo_sim.mazes import Maze

# Of the 3D world; a turn counts for more than the 9 degrees that it is: with these, a driver that holds its actions
# turns to and fro.
_TURN_A_FRAME_RAD = math.radians(12.0)
_TURN_COAST_FRAMES, _TRAVEL_COAST_FRAMES = 1.8, 4.2
_STRAIGHT_M_A_FRAME = 0.5
_TURNING_FRAMES = (0, 10, 21)  # straight on, through a bend, about
_STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))


class DistanceDriver(PathDriver):
    """Drives on as long as a corridor is straight; at its end it takes the way that promises most metres a frame.

    The ways are those to both sides and the one back. What each promises is its straight length over the time that the
    turn and the length take, in the 3D world. No more of the maze enters than what a robot sees at a corridor's end and
    remembers of it.

    hold_frames: in how many frames it is asked once, and its action held meanwhile.
    random_action_probability: as of any PathDriver.
    """

    def __init__(
        self, maze: Maze, rng: np.random.Generator, hold_frames: int = 1, random_action_probability: float = 0.05
    ) -> None:
        super().__init__(
            maze,
            rng,
            random_action_probability=random_action_probability,
            turn_per_action_rad=hold_frames * _TURN_A_FRAME_RAD,
            turn_coast_steps=_TURN_COAST_FRAMES / hold_frames,
            travel_coast_steps=_TRAVEL_COAST_FRAMES / hold_frames,
        )

    def _follow(self, block: tuple[int, int]) -> None:
        """Choose the next straight way where this one ends, or where block is not on it."""
        if self.goal is not None and block != self.goal and block in self._path_index:
            return
        if self.goal is not None and block == self.goal:
            self.goals_reached.append(self.goal)
        assert self._last_pose is not None
        yaw = self._last_pose[2]
        best, best_rate = [block], -1.0
        for step in _STEPS:
            way = self._straight(block, step)
            if len(way) == 1:
                continue
            turn_rad = abs(math.remainder(math.atan2(step[0], step[1]) - yaw, math.tau))
            turning = _TURNING_FRAMES[round(turn_rad / (math.pi / 2))]
            length_m = (len(way) - 1) * self.maze.block_m
            rate = length_m / (length_m / _STRAIGHT_M_A_FRAME + turning)
            if rate > best_rate:
                best, best_rate = way, rate
        self._path, self.goal = best, best[-1]
        self._path_index = {on_path: index for index, on_path in enumerate(best)}

    def _straight(self, block: tuple[int, int], step: tuple[int, int]) -> list[tuple[int, int]]:
        way = [block]
        while (ahead := (way[-1][0] + step[0], way[-1][1] + step[1])) in self.maze.graph:
            way.append(ahead)
        return way
