"""Drivers with a plan of the maze, and one by chance: what the robot does next, given its true pose.

They make the data; no estimate enters.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import IntEnum
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ngo_sim.mazes import Maze


class Action(IntEnum):
    """The three discrete actions of both worlds; action k is taken between frame k and frame k + 1."""

    FORWARD = 0
    TURN_LEFT = 1
    TURN_RIGHT = 2


_ACTIONS = tuple(Action)
_PATIENCE_STEPS = 40  # a half turn on the spot takes about 25
_LOOKAHEAD_BLOCKS = 0.9  # how far ahead on the path the robot aims


class Driver(Protocol):
    """Chooses an action for every frame."""

    def action(self, pose_xyyaw: np.ndarray, observation: npt.NDArray[Any] | None = None) -> Action:
        """The action to take at pose_xyyaw (3,) in the maze's frame; call it once a frame, in order.

        observation: what is seen there, of the world's shape and type; a driver that does not look needs none.
        """
        ...


class RandomDriver:
    """Every action equally likely, whatever the pose."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def action(self, pose_xyyaw: np.ndarray, observation: npt.NDArray[Any] | None = None) -> Action:
        """A random action; pose_xyyaw (3,) and observation are not looked at."""
        return _ACTIONS[int(self._rng.integers(3))]


class PathDriver:
    """Follows shortest paths from goal to goal, for ever.

    It steers towards a point a little ahead on the path, as seen from where the robot's momentum will carry
    it. Off the path it plans again from the block it is in; without progress it first returns to that block's
    centre, which nothing can obstruct.

    goals: "corners" visits the four corner cells in a random order, then in another one, ...; "random" visits
    random free blocks. goal is the (row, col) it is on the way to, goals_reached lists those before.
    random_action_probability: share of the actions replaced by a random one.
    turn_per_action_rad: how far one turn action turns the robot until it rests again.
    turn_coast_steps, travel_coast_steps: rotation and travel expected still to come without further
    acceleration, in multiples of the last step's.

    The defaults serve both worlds. Both turn about 9 degrees an action; the expected coasting is below that
    of the 2D world (1.5 and 4 steps) and of the 3D world (3 and 4.6 steps), because to overrate it makes the
    robot turn to and fro (twice the turns and half the way in 2D), while to underrate it only widens the
    bends a little.
    """

    def __init__(
        self,
        maze: Maze,
        rng: np.random.Generator,
        goals: str = "corners",
        *,
        random_action_probability: float = 0.05,
        turn_per_action_rad: float = math.radians(9.0),
        turn_coast_steps: float = 1.2,
        travel_coast_steps: float = 3.0,
    ) -> None:
        if goals not in ("corners", "random"):
            raise ValueError(f"goals is {goals!r}; it must be 'corners' or 'random'")
        self.goals_reached: list[tuple[int, int]] = []
        self.maze = maze
        self._rng = rng
        self._random_action_probability = random_action_probability
        self._deadband_rad = 0.5 * turn_per_action_rad  # within it, a turn leaves a larger error than none
        self._turn_coast_steps = turn_coast_steps
        self._travel_coast_steps = travel_coast_steps
        self._goals = self._corner_goals() if goals == "corners" else self._random_goals()
        self.goal: tuple[int, int] | None = None
        self._path: list[tuple[int, int]] = []
        self._path_index: dict[tuple[int, int], int] = {}
        self._last_pose: tuple[float, float, float] | None = None
        self._progress_pose = (math.inf, math.inf)
        self._steps_without_progress = 0
        self._returning = False

    def action(self, pose_xyyaw: np.ndarray, observation: npt.NDArray[Any] | None = None) -> Action:
        """The action to take at pose_xyyaw (3,) in the maze's frame; call it once a frame, in order.

        observation is not looked at.
        """
        x, y, yaw = pose_xyyaw.tolist()
        last_x, last_y, last_yaw = self._last_pose or (x, y, yaw)
        self._last_pose = (x, y, yaw)
        block = self.maze.block_at(x, y)
        self._follow(block)
        self._watch_progress(x, y, block)
        if self._rng.random() < self._random_action_probability:
            return _ACTIONS[int(self._rng.integers(3))]
        unit = 1.0 / self.maze.block_m
        coast = self._travel_coast_steps
        ahead_x, ahead_y = (x + coast * (x - last_x)) * unit, (y + coast * (y - last_y)) * unit
        if self._returning:
            target_x, target_y = block[1] + 0.5, block[0] + 0.5
        else:
            target_x, target_y = self._target(x * unit, y * unit, ahead_x, ahead_y, block)
        yaw_at_rest = yaw + self._turn_coast_steps * _wrap(yaw - last_yaw)
        error = _wrap(math.atan2(target_y - ahead_y, target_x - ahead_x) - yaw_at_rest)
        if abs(error) <= self._deadband_rad:
            return Action.FORWARD
        return Action.TURN_LEFT if error > 0 else Action.TURN_RIGHT

    def _follow(self, block: tuple[int, int]) -> None:
        """Take the next goal where this one is reached, and plan where block is not on the path."""
        while self.goal is None or block == self.goal:
            if self.goal is not None:
                self.goals_reached.append(self.goal)
            self.goal = next(self._goals)
            self._path_index = {}
        if block not in self._path_index:
            self._path = [(int(row), int(col)) for row, col in self.maze.shortest_path(block, self.goal)]
            self._path_index = {on_path: index for index, on_path in enumerate(self._path)}

    def _watch_progress(self, x: float, y: float, block: tuple[int, int]) -> None:
        """Return to the block's centre after _PATIENCE_STEPS within a fifth of a block, at most as long."""
        near = 0.2 * self.maze.block_m
        if math.hypot(x - self._progress_pose[0], y - self._progress_pose[1]) > near:
            self._progress_pose, self._steps_without_progress = (x, y), 0
        self._steps_without_progress += 1
        if self._steps_without_progress > _PATIENCE_STEPS:
            self._returning, self._steps_without_progress = not self._returning, 0
        center_x, center_y = (block[1] + 0.5) * self.maze.block_m, (block[0] + 0.5) * self.maze.block_m
        if self._returning and math.hypot(x - center_x, y - center_y) < near:
            self._returning = False

    def _target(
        self, x: float, y: float, ahead_x: float, ahead_y: float, block: tuple[int, int]
    ) -> tuple[float, float]:
        """The point to steer for, in blocks: on the path, beyond where the robot coasts to."""
        index = self._path_index[block]
        along = float(index) + self._offset_along(x, y, index)
        # Coasting does not follow a bend, yet its length says how far ahead the bend must be begun.
        along += math.hypot(ahead_x - x, ahead_y - y) + _LOOKAHEAD_BLOCKS
        along = min(max(along, 0.0), len(self._path) - 1.0)
        start = min(int(along), len(self._path) - 2)
        (row_a, col_a), (row_b, col_b) = self._path[start], self._path[start + 1]
        share = along - start
        return col_a + 0.5 + share * (col_b - col_a), row_a + 0.5 + share * (row_b - row_a)

    def _offset_along(self, x: float, y: float, index: int) -> float:
        """Progress in blocks beyond (or, negative, before) the centre of path block `index`."""
        row, col = self._path[index]
        off_x, off_y = x - col - 0.5, y - row - 0.5
        forward = backward = 0.0
        if index + 1 < len(self._path):
            next_row, next_col = self._path[index + 1]
            forward = max(off_x * (next_col - col) + off_y * (next_row - row), 0.0)
        if index > 0:
            last_row, last_col = self._path[index - 1]
            backward = max(off_x * (last_col - col) + off_y * (last_row - row), 0.0)
        return forward if forward >= backward else -backward

    def _corner_goals(self) -> Iterator[tuple[int, int]]:
        corners = [(int(row), int(col)) for row, col in self.maze.corners()]
        last = -1
        while True:
            order = self._rng.permutation(4).tolist()
            if order[0] == last:  # never the same corner twice in a row
                order = order[1:] + order[:1]
            last = order[-1]
            yield from (corners[index] for index in order)

    def _random_goals(self) -> Iterator[tuple[int, int]]:
        blocks = [(int(row), int(col)) for row, col in self.maze.free_blocks()]
        while True:
            yield blocks[int(self._rng.integers(len(blocks)))]


def _wrap(angle: float) -> float:
    return math.remainder(angle, math.tau)
