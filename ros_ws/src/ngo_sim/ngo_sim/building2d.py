"""A robot with a 2D lidar and wheel odometry in a building: one period after the other, or a whole drive as arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ngo_sim.building_drivers import BuildingDriver, BuildingDriverConfig
from ngo_sim.commanded_driver import CommandedDriver
from ngo_sim.convex_shapes import Floats
from ngo_sim.floor_plans import FloorPlan, FloorPlanConfig, draw_floor_plan
from ngo_sim.lidar import RayWorld, ScannerConfig, cast_scans, draw_scanner, ray_world
from ngo_sim.people import People
from ngo_sim.plan_files import read_floor_plan
from ngo_sim.routes import RouteMap
from ngo_sim.wheels import WheelOdometry, WheelsConfig, draw_wheels

_CHUNK = 512  # scans that a recording casts at once
_FRAMES_BETWEEN = 100_000  # from the begin of one drive through a building to that of the next


@dataclass(frozen=True, eq=False)
class BuildingFrame:
    """One scan and one reading of the wheels.

    stamp_s: of the scan's first ray, since the reset. ranges_m: float32 (rays,). wheel_stamp_s: of the wheels' reading,
    which is late or early by their lag. wheel_pose_xyyaw: (3,) in the wheels' own frame. true_pose_xyyaw: (3,) of the
    robot's middle at stamp_s, in the plan's frame. twist: (2,) true speed in m/s and turn rate in rad/s from then on.
    """

    index: int
    stamp_s: float
    ranges_m: npt.NDArray[np.float32]
    wheel_stamp_s: float
    wheel_pose_xyyaw: Floats
    true_pose_xyyaw: Floats
    twist: Floats


@dataclass(frozen=True, eq=False)
class BuildingDrive:
    """A whole drive of n scans: the fields of BuildingFrame, stacked, with what made them.

    stamps_s, wheel_stamps_s: (n,). ranges_m: float32 (n, rays). wheel_poses_xyyaw, true_poses_xyyaw: (n, 3).
    twists: (n, 2).
    """

    stamps_s: Floats
    ranges_m: npt.NDArray[np.float32]
    wheel_stamps_s: Floats
    wheel_poses_xyyaw: Floats
    true_poses_xyyaw: Floats
    twists: Floats
    plan: FloorPlan
    scanner: ScannerConfig
    wheels: WheelsConfig


class Building2d:
    """A building, its people and doors, and one robot.

    plan, driver: what is drawn from the seed and who drives. scanner, wheels: None draws each from the seed.

    reset(seed) makes everything a function of the seed and the configs, to the byte. Another drive through the same
    building, at another time, has another number. step() gives one frame after the
    other, the first one at the start; record() gives the same frames as arrays. A frame's rays are cast while the robot
    drives on, so step() moves the robot by one period.
    """

    def __init__(
        self,
        plan: FloorPlanConfig | None = None,
        scanner: ScannerConfig | None = None,
        wheels: WheelsConfig | None = None,
        driver: BuildingDriverConfig | None = None,
    ) -> None:
        self._plan_config = plan if plan is not None else FloorPlanConfig()
        self._scanner_config, self._wheels_config = scanner, wheels
        self._driver_config = driver if driver is not None else BuildingDriverConfig()
        self.plan: FloorPlan
        self.scanner: ScannerConfig
        self.wheels: WheelsConfig
        self._driver: BuildingDriver | CommandedDriver | None = None

    def reset(self, seed: int, drive: int = 0) -> None:
        """Draw the building, the robot and where it starts; the robot stands.

        Raises ValueError where the robot has no place in it, or a plan's file is no map.
        """
        config = self._plan_config
        self.plan = (
            read_floor_plan(Path(config.plan).expanduser(), seed) if config.plan else draw_floor_plan(seed, config)
        )
        streams = [np.random.default_rng((int(seed), 2, part)) for part in range(6)]
        if drive:
            streams[2:] = [np.random.default_rng((int(seed), 2, part, drive)) for part in range(2, 6)]
        drawn = draw_scanner(streams[0])
        self.scanner = self._scanner_config if self._scanner_config is not None else drawn
        self.wheels = self._wheels_config if self._wheels_config is not None else draw_wheels(streams[1])
        routes = RouteMap(self.plan, self._driver_config.radius_m)
        self.period_s = self.scanner.scan_period_s
        self._world = _world_of(self.plan)
        self._driver = self._make_driver(routes, streams[2])
        self._people = People(routes, self._plan_config.people, streams[3])
        self._odometry = WheelOdometry(self.wheels, self.period_s, streams[4])
        self._noise = streams[5]
        self._index = _FRAMES_BETWEEN * drive

    def _make_driver(self, routes: RouteMap, rng: np.random.Generator) -> BuildingDriver | CommandedDriver:
        config = self._driver_config
        if config.driver != "cmd_vel":
            return BuildingDriver(routes, config, self.period_s, rng)
        goal = routes.goals_m[int(rng.integers(len(routes.goals_m)))]
        start = np.array((*routes.path(goal, goal)[0], rng.uniform(-math.pi, math.pi)))
        return CommandedDriver(self._world, self._leaves_at, config, self.period_s, start)

    def _leaves_at(self, time_s: float) -> Floats:
        return self.plan.doors.leaves(np.array((time_s,)))[0]

    def command(self, speed_mps: float, turn_rate_rps: float) -> None:
        """Drive so from the next frame on; raises ValueError unless the driver is cmd_vel and both are finite."""
        if not isinstance(self._driver, CommandedDriver):
            raise ValueError(f"driver is {self._driver_config.driver!r}; a command needs 'cmd_vel'")
        self._driver.command.set(speed_mps, turn_rate_rps)

    @property
    def blocked(self) -> bool:
        """Whether something stopped a robot that is commanded on its way to the next frame."""
        return isinstance(self._driver, CommandedDriver) and self._driver.blocked

    def step(self) -> BuildingFrame:
        """The next frame. Raises RuntimeError before the first reset."""
        drive = self._drive(1)
        return BuildingFrame(
            self._index - 1,
            float(drive.stamps_s[0]),
            drive.ranges_m[0],
            float(drive.wheel_stamps_s[0]),
            drive.wheel_poses_xyyaw[0],
            drive.true_poses_xyyaw[0],
            drive.twists[0],
        )

    def record(self, seed: int, length_m: float, most_scans: int = 100_000, drive: int = 0) -> BuildingDrive:
        """Reset and drive until the robot has gone length_m, or until there are most_scans."""
        if not 0.0 < length_m <= 100_000.0:
            raise ValueError(f"length_m is {length_m!r}; it must be above 0 and at most 100000")
        if most_scans < 1:
            raise ValueError(f"most_scans is {most_scans!r}; it must be 1 or more")
        self.reset(seed, drive)
        return self._drive(most_scans, length_m)

    def _drive(self, most_scans: int, length_m: float = np.inf) -> BuildingDrive:
        if self._driver is None:
            raise RuntimeError("step() before reset()")
        driver, gone = self._driver, 0.0
        poses: list[Floats] = []
        twists: list[Floats] = []
        while len(poses) < most_scans and gone < length_m:
            poses.append(driver.pose_xyyaw)
            twists.append(driver.advance())
            gone += abs(twists[-1][0]) * self.period_s
        true_poses, moved = np.array(poses), np.array(twists)
        count = len(true_poses)
        stamps = (self._index + np.arange(count, dtype=np.float64)) * self.period_s
        self._index += count
        # The wheels count the period that ends at the next frame: their reading now is the one before it.
        before = self._odometry.pose_xyyaw
        wheel_poses = np.concatenate((before[None], self._odometry.advance(moved * self.period_s)))[:-1]
        ranges = np.empty((count, self.scanner.rays), np.float32)
        for begin in range(0, count, _CHUNK):
            part = slice(begin, min(begin + _CHUNK, count))
            ranges[part] = cast_scans(
                self._world,
                self.scanner,
                true_poses[part],
                moved[part],
                self.plan.doors.leaves(stamps[part]),
                self._people.circles(stamps[part], true_poses[part, :2]),
                self._noise,
            )
        return BuildingDrive(
            stamps,
            ranges,
            stamps - self.wheels.lag_s,
            wheel_poses,
            true_poses,
            moved,
            self.plan,
            self.scanner,
            self.wheels,
        )


def _world_of(plan: FloorPlan) -> RayWorld:
    swing = np.column_stack((plan.doors.hinges_m, plan.doors.widths_m))
    return ray_world(plan.segments_m, plan.glass, plan.circles_m, swing)
