"""Simulated episodes, and their images and ranges."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from training.data.data_source import MIRRORED_ACTIONS
from training.data.worlds import DRAWN, MazeSize, World

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode
    from ngo_sim.mazes import Maze

GROUP = 8  # Episodes that are simulated in mazes of one size before another size is drawn.


def simulate(world: World, seeds: list[int], frames: int, size: MazeSize = DRAWN) -> Iterator[Episode]:
    """Episodes of ``frames`` frames in the mazes of ``seeds``, all of one size; what is drawn depends on the first."""
    return episodes_in(world, seeds, seeds, frames, size, world.driver)


def episodes_in(
    world: World, mazes: Sequence[int], seeds: Sequence[int], frames: int, size: MazeSize, driver: str
) -> Iterator[Episode]:
    """Episodes of ``frames`` frames, in the maze of each of ``mazes`` with start, noise and driver of one of ``seeds``.

    All mazes are of one size, and what is drawn of it depends on the first.
    """
    from ngo_sim.episodes import record_episode  # training on recordings does without the simulators

    if world.name == "doom":
        from training.data.doom_drives import doom_episodes

        yield from doom_episodes(seeds, frames)
        return
    env = world.make_random(np.random.default_rng(mazes[0]), size)
    try:
        if hasattr(env, "preload"):
            env.preload(seeds, mazes)
        for maze, seed in zip(mazes, seeds, strict=True):
            yield record_episode(env, driver, frames, seed, {} if maze == seed else {"maze_seed": maze})
    finally:
        env.close()


def images_of(world: World, episode: Episode) -> Tensor:
    """An episode's observations as ``(frames, height, width, channels)``."""
    return torch.from_numpy(episode.observations).reshape(-1, *world.image.shape)


def mirrored_episode(world: World, episode: Episode) -> Episode:
    """An episode as a mirror shows it: left and right exchanged in its pictures, actions and poses."""
    return dataclasses.replace(
        episode,
        observations=images_of(world, episode).flip(-2).numpy(),
        actions=np.array(MIRRORED_ACTIONS, dtype=episode.actions.dtype)[episode.actions],
        poses_xyyaw=episode.poses_xyyaw * np.array([1.0, -1.0, -1.0]),
    )


def wall_ranges(maze: Maze, poses_xyyaw: np.ndarray, angles_rad: np.ndarray) -> np.ndarray:
    """True distances ``(..., rays)`` in m, float32, of the first walls along rays from poses ``(..., 3)``."""
    from ngo_sim.raycast import cast_rays  # training on recordings does without the simulators

    poses = poses_xyyaw.reshape(-1, 3)
    scans = np.empty((len(poses), len(angles_rad), 4), dtype=np.float32)  # colour, not asked for, and distance
    colours = np.zeros((*maze.walls.shape, 3), dtype=np.float32)
    rays = np.cos(angles_rad), np.sin(angles_rad)
    for (x, y, yaw), scan in zip(poses.tolist(), scans, strict=True):
        cast_rays(maze.walls, maze.block_m, x, y, yaw, *rays, colours, scan)
    return scans[..., 3].reshape(*poses_xyyaw.shape[:-1], len(angles_rad))
