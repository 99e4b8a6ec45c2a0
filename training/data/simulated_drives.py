"""Simulated drives of a lidar through mazes, without wheels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan
from ngo_sim.episodes import Episode, record_episode
from ngo_sim.maze2d import Maze2DConfig
from training.data.lidar_drives import LidarDrive, TruePoses, simulated_stamps_ns
from training.data.scans import ROWS, SCAN_IMAGE, ScannedMaze
from training.data.worlds import WORLDS

_FRAME = "laser"
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
    return _of_maze(f"maze2d_{seed}", identity, episode, depths, angles, _UNLIMITED_M)


def scanned_maze_drive(seed: int, frames: int, changes: Mapping[str, Any]) -> LidarDrive:
    """A drive through a maze of drawn width, seen by a drawn scanner with ``changes`` to its properties; no wheels."""
    rng = np.random.default_rng(seed)
    rows = int(rng.integers(ROWS[0], ROWS[1] + 1))
    size = {"rows": rows, "cols": rows, "extra_openings": int(rng.integers(0, 9))}
    maze = _RawScans(SCAN_IMAGE, size, changes)
    episode = record_episode(maze, WORLDS["maze2d"].driver, frames, seed)
    named = ", ".join(f"{name} {value:g}" for name, value in changes.items()) or "as drawn"
    return _of_maze(
        f"scanned_maze_{seed}",
        f"scanned maze seed {seed}, {named}, {frames} frames",
        episode,
        episode.observations,
        maze.angles,
        maze.scanner.range_max_m,
    )


class _RawScans(ScannedMaze):
    """A scanned maze that is observed as its scanner's rays; ``angles`` are that of the first and their step."""

    angles: tuple[float, float]

    def _scan(self, observation: np.ndarray) -> np.ndarray:
        ranges, *self.angles = self.rays(observation)  # type: ignore[assignment]
        return ranges.astype(np.float32)


def _of_maze(
    name: str, identity: str, episode: Episode, ranges: np.ndarray, angles: tuple[float, float], range_max_m: float
) -> LidarDrive:
    stamps_ns = simulated_stamps_ns(np.arange(len(ranges)) * episode.period_s)
    scans = tuple(
        LidarScan(stamp_ns, *angles, row, 0.0, range_max_m, 0.0, _FRAME)
        for stamp_ns, row in zip(stamps_ns.tolist(), ranges, strict=True)
    )
    return LidarDrive(name, identity, scans, (), Mounting(np.zeros(3)), TruePoses(stamps_ns, episode.poses_xyyaw))
