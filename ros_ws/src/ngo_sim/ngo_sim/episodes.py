"""Recorded episodes: what a driver saw, did and where it was, as arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from ngo_sim.driver_choice import driver_generator, make_driver
from ngo_sim.mazes import Maze


@dataclass(frozen=True, eq=False)
class Episode:
    """One recorded episode; frame k is seen at pose k and action k is taken between frame k and frame k + 1.

    observations: (frames, ...) of the world's shape and type. actions: uint8 (frames - 1,).
    poses_xyyaw: float64 (frames, 3) in the maze's frame, m, m, rad. period_s: time between two frames.
    maze: where it was recorded, None on a Doom map.
    """

    observations: npt.NDArray[Any]
    actions: npt.NDArray[np.uint8]
    poses_xyyaw: npt.NDArray[np.float64]
    period_s: float
    maze: Maze | None


def record_episode(
    env: gymnasium.Env[Any, Any],
    driver_name: str,
    frames: int,
    seed: int,
    options: dict[str, Any] | None = None,
    watch: Callable[[Any, npt.NDArray[Any]], None] | None = None,
) -> Episode:
    """Record `frames` (at least 1) of a Maze2D or Maze3D; world, noise and driver are functions of seed.

    driver_name is one of driver_choice.DRIVER_NAMES; ValueError where the world does not suit it. options are those of
    the environment's reset. ``watch`` is called with the world and the observation of each frame.
    """
    if isinstance(frames, bool) or not isinstance(frames, (int, np.integer)) or frames < 1:
        raise ValueError(f"frames is {frames!r}; it must be an integer of at least 1")
    world: Any = env.unwrapped
    observation, info = env.reset(seed=seed, options=options or None)
    driver = make_driver(driver_name, world.maze, driver_generator(seed))
    observations = np.empty((frames, *observation.shape), dtype=observation.dtype)
    actions = np.empty(frames - 1, dtype=np.uint8)
    poses_xyyaw = np.empty((frames, 3))
    observations[0], poses_xyyaw[0] = observation, info["pose_xyyaw"]
    if watch is not None:
        watch(world, observation)
    for frame in range(frames - 1):
        action = driver.action(info["pose_xyyaw"], observation)
        observation, _, _, _, info = env.step(action)
        actions[frame] = action
        observations[frame + 1], poses_xyyaw[frame + 1] = observation, info["pose_xyyaw"]
        if watch is not None:
            watch(world, observation)
    return Episode(observations, actions, poses_xyyaw, world.period_s, world.maze)
