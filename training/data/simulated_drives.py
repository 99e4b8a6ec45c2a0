"""Simulated drives of a lidar: buildings with wheels that nobody calibrated, and mazes without wheels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from ngo_sim.building2d import Building2d
from ngo_sim.episodes import Episode, record_episode
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.maze2d import Maze2DConfig
from training.data.lidar_drives import LidarDrive, TruePoses
from training.data.scans import ROWS, SCAN_IMAGE, ScannedMaze
from training.data.worlds import WORLDS

BUILDING_TEST_SEEDS = range(20_000, 30_000)
"""Buildings for final tables; what learns takes seeds below 10,000, what chooses settings those between."""

_START_NS = 1_000_000_000  # of simulated stamps: 0 means unknown in ROS
_FRAME = "laser"
_UNLIMITED_M = 100.0  # range limit of a scanner that has none


def building_drive(seed: int, length_m: float, aliased: bool = False, most_scans: int = 100_000) -> LidarDrive:
    """A drive of ``length_m`` through the building of ``seed``, by the scanner and the wheels that are drawn for it."""
    drive = Building2d(FloorPlanConfig(aliased=aliased)).record(seed, length_m, most_scans)
    scanner = drive.scanner
    increment = scanner.increment_rad * (1.0 + scanner.increment_error)
    stamps_ns = _stamps_ns(drive.stamps_s)
    scans = tuple(
        LidarScan(
            stamp_ns,
            float(scanner.angles_rad[0]),
            increment,
            ranges,
            scanner.range_min_m,
            scanner.range_max_m,
            scanner.time_increment_s,
            _FRAME,
        )
        for stamp_ns, ranges in zip(stamps_ns.tolist(), drive.ranges_m, strict=True)
    )
    wheels = tuple(map(WheelPose, _stamps_ns(drive.wheel_stamps_s).tolist(), drive.wheel_poses_xyyaw))
    pose = np.array((scanner.laser_x_m, scanner.laser_y_m, math.radians(scanner.laser_yaw_deg)))
    return LidarDrive(
        f"{'aliased' if aliased else 'building'}_{seed}",
        f"building seed {seed}, aliased {aliased}, {length_m:g} m, at most {most_scans} scans",
        scans,
        wheels,
        Mounting(pose, scanner.upside_down),
        TruePoses(stamps_ns, drive.true_poses_xyyaw),
    )


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
    stamps_ns = _stamps_ns(np.arange(len(ranges)) * episode.period_s)
    scans = tuple(
        LidarScan(stamp_ns, *angles, row, 0.0, range_max_m, 0.0, _FRAME)
        for stamp_ns, row in zip(stamps_ns.tolist(), ranges, strict=True)
    )
    return LidarDrive(name, identity, scans, (), Mounting(np.zeros(3)), TruePoses(stamps_ns, episode.poses_xyyaw))


def _stamps_ns(stamps_s: np.ndarray) -> np.ndarray:
    return _START_NS + np.rint(stamps_s * 1e9).astype(np.int64)
