"""Simulated drives of a lidar through mazes, without wheels."""

from __future__ import annotations

import math

import numpy as np

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan
from ngo_sim.episodes import record_episode
from ngo_sim.maze2d import Maze2DConfig
from training.data.lidar_drives import LidarDrive, TruePoses, simulated_stamps_ns
from training.data.worlds import WORLDS

_UNLIMITED_M = 100.0  # range limit of a scanner that has none


def maze_drive(seed: int, frames: int, size_seed: int | None = None) -> LidarDrive:
    """A drive through a maze of ``maze2d``, seen by that simulator's own scanner: 300 deg, free of noise, no wheels.

    The maze's size is drawn from ``size_seed``, by default from ``seed``.
    """
    world, config = WORLDS["maze2d"], Maze2DConfig()
    env = world.make_random(np.random.default_rng(seed if size_seed is None else size_seed))
    episode = record_episode(env, world.driver, frames, seed)
    env.close()
    half = 0.5 * math.radians(config.field_of_view_deg)
    depths = episode.observations[..., 3].reshape(frames, -1)
    angles = (half, -2.0 * half / (depths.shape[1] - 1))
    identity = f"maze2d seed {seed}, size by {size_seed}, {frames} frames"
    stamps_ns = simulated_stamps_ns(np.arange(frames) * episode.period_s)
    scans = tuple(
        LidarScan(stamp_ns, *angles, row, 0.0, _UNLIMITED_M, 0.0, "laser")
        for stamp_ns, row in zip(stamps_ns.tolist(), depths, strict=True)
    )
    truth = TruePoses(stamps_ns, episode.poses_xyyaw)
    return LidarDrive(f"maze2d_{seed}", identity, scans, (), Mounting(np.zeros(3)), truth)
