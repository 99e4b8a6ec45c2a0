"""Driving as a task for reinforcement learning: look, decide for the next few frames, earn the way covered."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import gymnasium
import numpy as np

from ngo_sim.maze3d import Maze3D, Maze3DConfig
from ngo_sim.mazes import Maze
from ngo_sim.policy_network import ACTIONS, SENSES, PolicyConfig, PolicyView
from training.data.worlds import TRAIN_SEEDS, World

Look = dict[str, Any]

REWARD_PER_M = 0.05
"""Keeps the discounted sum of rewards near 1: the value's gradients must not drown those of the decisions."""


class DrivingTask(gymnasium.Env[Look, np.int64]):
    """Mazes of the training split of a world, each driven through once for ``frames`` frames.

    Observations are what PolicyView holds, as a dict: ``pictures`` uint8 (pictures, height, width) and ``senses``
    float32 (8,). A step is a decision: config.hold_frames frames of the simulator, taken at once. Its reward is the
    distance travelled in m times REWARD_PER_M. ``mazes`` of one size are made at a time. Which mazes come is a function
    of ``stream``, any sequence of whole numbers.
    """

    def __init__(self, world: World, config: PolicyConfig, stream: tuple[int, ...], frames: int, mazes: int) -> None:
        self._world, self.config, self._frames, self._mazes = world, config, frames, mazes
        self._rng = np.random.default_rng(stream)
        self._env: Any = None
        self._seeds: list[int] = []
        self._decisions = 0
        self.action_space = gymnasium.spaces.Discrete(ACTIONS)
        pictures = (config.pictures, config.height, config.width)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "pictures": gymnasium.spaces.Box(0, 255, pictures, np.uint8),
                "senses": gymnasium.spaces.Box(-100.0, 100.0, (SENSES,), np.float32),
            }
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Look, dict[str, Any]]:
        """Stand at the start of the next maze; seed and options change nothing, the stream decides."""
        if not self._seeds:
            self.close()
            rows, most_rows = self._world.rows
            openings, most_openings = self._world.extra_openings
            size = int(self._rng.integers(rows, most_rows + 1))
            extra = int(self._rng.integers(openings, most_openings + 1))
            self._env = Maze3D(held(Maze3DConfig(size, size, extra), self.config.hold_frames))
            self._seeds = self._rng.integers(TRAIN_SEEDS.start, TRAIN_SEEDS.stop, self._mazes).tolist()
            self._env.preload(self._seeds)
        observation, info = self._env.reset(seed=self._seeds.pop())
        self._view, self._decisions = PolicyView(self.config), 0
        self._view.see(observation, info["pose_xyyaw"])
        return self._look(), info

    def step(self, action: np.int64 | int) -> tuple[Look, float, bool, bool, dict[str, Any]]:
        """Take a decision; an episode is cut off after its frames."""
        observation, travelled, _, _, info = self._env.step(int(action))
        self._view.did(int(action))
        self._view.see(observation, info["pose_xyyaw"])
        self._decisions += 1
        over = self._decisions * self.config.hold_frames >= self._frames
        return self._look(), REWARD_PER_M * travelled, False, over, info

    @property
    def maze(self) -> Maze | None:
        """The maze that is driven through; None before a reset."""
        return None if self._env is None else self._env.maze

    def close(self) -> None:
        """End the world's engine."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _look(self) -> Look:
        return {"pictures": self._view.pictures.copy(), "senses": self._view.senses.copy()}


def held(config: Maze3DConfig, frames: int) -> Maze3DConfig:
    """The world in which one step is about what ``frames`` steps with the same action are in that of ``config``.

    It is rendered once in these frames, which makes training several times as fast. A turn action turns the robot by as
    much until it rests again, and its rate falls as fast; only within a decision the course differs a little.
    """
    decay = config.turn_decay**frames
    resting_deg = config.turn_deg / (1.0 - config.turn_decay)
    return dataclasses.replace(
        config,
        frame_skip=frames * config.frame_skip,
        turn_decay=decay,
        turn_deg=frames * resting_deg * (1.0 - decay),
        actuation_noise=config.actuation_noise / math.sqrt(frames),
    )
