"""Driving as a task for reinforcement learning: look, hold an action for a few frames, be paid for the way covered."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from ngo_sim.policy_network import ACTIONS, PolicyConfig, PolicyView
from training.worlds import TRAIN_SEEDS, World

Look = dict[str, Any]

REWARD_PER_M = 0.1
"""Keeps the discounted sum of rewards near 1, the size that a value network learns fast."""


class DrivingTask(gymnasium.Env[Look, np.int64]):
    """Mazes of the training split of a world, each driven through once for ``frames`` frames.

    Observations are what PolicyView holds, as a dict: ``pictures`` uint8 (pictures, height, width) and ``last_action``
    float32 (3,). A step is a decision: its action is held for config.hold_frames frames, its reward is the distance
    travelled in m times REWARD_PER_M. ``mazes`` of one size are made at a time. Which mazes come is a function of
    ``stream``, any sequence of whole numbers.
    """

    def __init__(self, world: World, config: PolicyConfig, stream: tuple[int, ...], frames: int, mazes: int) -> None:
        self._world, self._config, self._frames, self._mazes = world, config, frames, mazes
        self._rng = np.random.default_rng(stream)
        self._env: Any = None
        self._seeds: list[int] = []
        self._decisions = 0
        self.action_space = gymnasium.spaces.Discrete(ACTIONS)
        pictures = (config.pictures, config.height, config.width)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "pictures": gymnasium.spaces.Box(0, 255, pictures, np.uint8),
                "last_action": gymnasium.spaces.Box(0.0, 1.0, (ACTIONS,), np.float32),
            }
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Look, dict[str, Any]]:
        """Stand at the start of the next maze; seed and options change nothing, the stream decides."""
        if not self._seeds:
            self.close()
            self._env = self._world.make_random(self._rng)
            self._seeds = self._rng.integers(TRAIN_SEEDS.start, TRAIN_SEEDS.stop, self._mazes).tolist()
            self._env.preload(self._seeds)
        observation, info = self._env.reset(seed=self._seeds.pop())
        self._view, self._decisions = PolicyView(self._config), 0
        self._view.see(observation)
        return self._look(), info

    def step(self, action: np.int64 | int) -> tuple[Look, float, bool, bool, dict[str, Any]]:
        """Hold an action; an episode is cut off after its frames."""
        travelled = 0.0
        for _ in range(self._config.hold_frames):
            observation, reward, _, _, info = self._env.step(int(action))
            travelled += reward
        self._view.did(int(action))
        self._view.see(observation)
        self._decisions += 1
        over = self._decisions * self._config.hold_frames >= self._frames
        return self._look(), REWARD_PER_M * travelled, False, over, info

    def close(self) -> None:
        """End the world's engine."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _look(self) -> Look:
        return {"pictures": self._view.pictures.copy(), "last_action": self._view.last_action.copy()}
