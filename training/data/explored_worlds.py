"""Worlds to explore in this process: buildings, drawn or from a file, and 2D mazes, with a robot that is commanded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.ndimage import label

from ngo_estimator.mapping.range_scan import RangeScan, range_scan
from ngo_recordings.scan_stream import LidarScan, WheelPose
from ngo_sim.building2d import Building2d
from ngo_sim.building_drivers import BuildingDriverConfig
from ngo_sim.floor_plans import FloorPlan, FloorPlanConfig
from ngo_sim.lidar import ScannerConfig, cast_scans, ray_world
from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.raycast import cast_rays
from ngo_sim.routes import CELL_M, RouteMap
from ngo_sim.simulation import Simulation
from ngo_sim.wheels import WheelsConfig
from training.data.building_drives import measured_scan
from training.data.lidar_drives import simulated_stamps_ns

_APART_M = 0.4  # between two places that say what can be seen
_RAYS = 720
_GAP_M = 0.05  # between the leaf of a door that is shut and its frame, at most
RANGE_M = 12.0  # of the exact rays, and of most robots' lidars

WHEELS = {
    "good_wheels": WheelsConfig(left_bias=0.002, right_bias=-0.001, wheel_noise=0.005),
    "slipping_wheels": WheelsConfig(left_bias=0.03, right_bias=0.028, wheel_noise=0.01, slips_per_km=60.0),
    "no_wheels": None,
    "short_range": None,
}
"""Wheels of a robot that estimates its poses, by how good they are; None: its lidar is all that it has."""
RANGES_M = {"short_range": 4.0}
"""Of a lidar that sees less far than the others: in the middle of a long corridor it sees nothing that moves."""


@dataclass(frozen=True, eq=False)
class Sight:
    """Where a robot is and what it sees: true pose ``(3,)``, the rays, and whether something stopped it on the way.

    ``stamp_ns`` and ``records`` are of what an estimator hears: wheels, where the robot has any, and the scan.
    """

    time_s: float
    pose_xyyaw: np.ndarray
    scan: RangeScan
    blocked: bool
    stamp_ns: int = 0
    records: Sequence[LidarScan | WheelPose] = ()


class ExploredWorld(Protocol):
    """A world with a robot in it that drives by velocities."""

    radius_m: float
    range_m: float

    def step(self, speed_mps: float, turn_rate_rps: float) -> Sight:
        """Drive for one period."""
        ...

    def exact_scans(self) -> tuple[list[RangeScan], np.ndarray]:
        """What can be seen: exact scans all around, and their poses ``(n, 3)`` all over where the robot can go."""
        ...

    def in_reach(self, poses_xyyaw: np.ndarray) -> np.ndarray:
        """``(n,)`` whether a way leads to places ``(n, 3)`` from where the robot is, as doors stand now."""
        ...


class Building:
    """A building of a seed; a robot with a lidar of 270 degrees, and with ``wheels`` if it tells of any."""

    def __init__(
        self,
        seed: int,
        plan: FloorPlanConfig,
        speed_mps: float = 1.0,
        wheels: WheelsConfig | None = None,
        range_m: float = RANGE_M,
    ) -> None:
        self._driver = BuildingDriverConfig(driver="cmd_vel", speed_mps=speed_mps, acceleration_mps2=1.0)
        self.radius_m, self.range_m = self._driver.radius_m, range_m
        self._scanner = ScannerConfig(range_max_m=range_m, rays=360)
        self._angles = self._scanner.base_angles_rad()
        self._has_wheels = wheels is not None
        self._building = Building2d(plan, self._scanner, wheels or WheelsConfig(), self._driver)
        self._building.reset(seed)
        self._sight: Sight | None = None

    @property
    def plan(self) -> FloorPlan:
        """The floor plan."""
        return self._building.plan

    def step(self, speed_mps: float, turn_rate_rps: float) -> Sight:
        """Drive for one period, and look."""
        self._building.command(speed_mps, turn_rate_rps)
        frame = self._building.step()
        # Of rays without a return nothing is known: glass, a dropout, or nothing within the range.
        scan = range_scan(self._angles, frame.ranges_m.astype(np.float64), np.zeros(3), self.range_m)
        stamp_ns, wheels_ns = simulated_stamps_ns(np.array((frame.stamp_s, frame.wheel_stamp_s))).tolist()
        wheels = [WheelPose(wheels_ns, frame.wheel_pose_xyyaw)] if self._has_wheels else []
        records: list[LidarScan | WheelPose] = [*wheels, measured_scan(self._scanner, stamp_ns, frame.ranges_m)]
        self._sight = Sight(frame.stamp_s, frame.true_pose_xyyaw, scan, self._building.blocked, stamp_ns, records)
        return self._sight

    def exact_scans(self) -> tuple[list[RangeScan], np.ndarray]:
        """Exact scans all over where the robot can go; doors that it cannot rely on are shut, and glass is a wall."""
        plan = self._building.plan
        area = RouteMap(plan, self.radius_m).area
        step = round(_APART_M / CELL_M)
        cells = np.argwhere(area[::step, ::step]) * step
        poses = np.column_stack(((cells[:, ::-1] + 0.5) * CELL_M, np.zeros(len(cells))))
        exact = ScannerConfig(
            rays=_RAYS, field_of_view_deg=360.0, range_max_m=RANGE_M, noise_m=0.0, noise_per_m=0.0, dropout=0.0
        )
        doors = replace(plan.doors, widths_m=plan.doors.widths_m + _GAP_M)  # nothing is seen behind those that are shut
        swing = np.column_stack((doors.hinges_m, doors.widths_m))
        world = ray_world(plan.segments_m, np.zeros(len(plan.glass), np.bool_), plan.circles_m, swing)
        opened = np.where(doors.passable, doors.angles_rad[:, 0], 0.0)[None]
        leaves = np.repeat(doors.leaves_at(opened), len(poses), axis=0)
        ranges = cast_scans(
            world,
            exact,
            poses,
            np.zeros((len(poses), 2)),
            leaves,
            np.zeros((len(poses), 0, 3)),
            np.random.default_rng(0),
        )
        return [range_scan(exact.base_angles_rad(), row.astype(float), np.zeros(3), RANGE_M) for row in ranges], poses

    def in_reach(self, poses_xyyaw: np.ndarray) -> np.ndarray:
        """By the leaves of the doors where they are now."""
        plan, doors = self._building.plan, self._building.plan.doors
        if not len(doors.hinges_m) or self._sight is None:
            return np.ones(len(poses_xyyaw), np.bool_)
        opened = np.repeat(doors.opened_rad(np.array((self._sight.time_s,))), doors.angles_rad.shape[1], axis=0).T
        stand = replace(doors, angles_rad=opened, passable=np.ones(len(opened), np.bool_))
        areas, _ = label(RouteMap(replace(plan, doors=stand), self.radius_m).safe, np.ones((3, 3)))
        cells = np.argwhere(areas)
        robot = self._sight.pose_xyyaw[1::-1] / CELL_M
        here = areas[tuple(cells[np.argmin(np.sum((cells + 0.5 - robot) ** 2, axis=1))])]
        row, column = (poses_xyyaw[:, 1::-1] / CELL_M).astype(np.int64).T
        return np.asarray(areas[row, column] == here)


class Maze:
    """A 2D maze of a seed; rays end at its walls."""

    def __init__(self, seed: int, config: Maze2DConfig) -> None:
        self._world = Maze2D(config)
        self._run = Simulation(self._world, seed, "cmd_vel")
        self.radius_m = config.radius_m
        self.range_m = math.hypot(*self._world.maze.size_m) + 1.0

    def step(self, speed_mps: float, turn_rate_rps: float) -> Sight:
        """Drive for one period, and look."""
        assert self._run.velocity is not None
        self._run.velocity.set(speed_mps, turn_rate_rps)
        frame, blocked = self._run.drive()
        ranges = frame.observation[:, 3].astype(np.float64)
        scan = range_scan(self._world.ray_angles_rad, ranges, np.zeros(3), self.range_m)
        return Sight(frame.index * self._world.period_s, frame.pose_xyyaw, scan, blocked)

    def exact_scans(self) -> tuple[list[RangeScan], np.ndarray]:
        """Exact scans from several places of every free block."""
        maze, radius = self._world.maze, self.radius_m
        inset = (maze.block_m / 2 - radius) * 0.9
        offsets = [(x, y) for x in (-inset, 0.0, inset) for y in (-inset, 0.0, inset)]
        middles = maze.block_center(maze.free_blocks())
        poses = np.concatenate([np.column_stack((middles + offset, np.zeros(len(middles)))) for offset in offsets])
        angles = np.linspace(-math.pi, math.pi, _RAYS, endpoint=False)
        scans, seen = [], np.empty((_RAYS, 4), np.float32)
        colors = np.zeros((*maze.walls.shape, 3), np.float32)
        for x, y, yaw in poses.tolist():
            cast_rays(maze.walls, maze.block_m, x, y, yaw, np.cos(angles), np.sin(angles), colors, seen)
            scans.append(range_scan(angles, seen[:, 3].astype(np.float64), np.zeros(3), self.range_m))
        return scans, poses

    def in_reach(self, poses_xyyaw: np.ndarray) -> np.ndarray:
        """All of them: a maze has no doors."""
        return np.ones(len(poses_xyyaw), np.bool_)
