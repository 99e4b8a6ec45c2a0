"""Make the stored drives anew.

    python -m tests.golden.make_drives [name ...]

The frames come from the simulators, so this needs ViZDoom for ``maze3d`` and ``doom``; the tests themselves do not. No
table, no choice of settings and no training uses these seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ngo_sim.building2d import Building2d
from ngo_sim.building_drivers import BuildingDriverConfig
from ngo_sim.episodes import Episode, record_episode
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.wheels import WheelsConfig
from tests.golden.drives import GoldenDrive
from tests.golden.lidar_drives import GoldenLidarDrive
from training.data.batches import seen_from_first
from training.data.doom_drives import MAZES, ROOMS, VALIDATION_MAPS, map_drive
from training.data.episodes import images_of
from training.data.worlds import World, world_named

Changes = Mapping[str, Any]


@dataclass(frozen=True)
class Building:
    """A drive of a lidar: the ``scans`` of a building's ``seed``, and what is not as the seed draws it.

    ``scanner`` and ``wheels`` change what is drawn, ``plan`` and ``driver`` the simulator's defaults.
    """

    seed: int
    scans: int = 500
    plan: Changes = field(default_factory=dict)
    scanner: Changes = field(default_factory=dict)
    wheels: Changes = field(default_factory=dict)
    driver: Changes = field(default_factory=dict)
    with_wheels: bool = True

    def make(self) -> GoldenLidarDrive:
        """Drive through the building."""
        plan = FloorPlanConfig(**{"scale": 0.5, "people": 1, **self.plan})
        drawn = Building2d(plan)
        drawn.reset(self.seed)
        building = Building2d(
            plan,
            replace(drawn.scanner, **self.scanner),
            replace(drawn.wheels, **self.wheels),
            BuildingDriverConfig(**{"driver": "patrol", "stand": 0.0, "spin": 0.0, "speed_mps": 1.0, **self.driver}),
        )
        return GoldenLidarDrive.of(building.record(self.seed, 10_000.0, self.scans), self.with_wheels)


# Few rays make small files, and a slow scanner sees the robot come back in few scans.
_FEW = {"rays": 121, "scan_period_s": 0.2}
_SCANNER = {
    **_FEW,
    "field_of_view_deg": 270.0,
    "range_max_m": 12.0,
    "noise_m": 0.01,
    "noise_per_m": 0.001,
    "dropout": 0.002,
    "resolution_m": 0.005,
    "sweep": 0.0,
    "clockwise": False,
}
_CALM = {"slips_per_km": 0.0, "freezes_per_hour": 0.0, "jumps_per_hour": 0.0, "lag_s": 0.0}


def _building(seed: int, scanner: Changes | None = None, wheels: Changes | None = None, **other: Any) -> Building:
    """One with a usual scanner and calm wheels but for what is given."""
    return Building(seed, scanner={**_SCANNER, **(scanner or {})}, wheels={**_CALM, **(wheels or {})}, **other)


LIDAR_DRIVES = {
    "scan_ring": Building(
        900_000_001,
        400,
        plan={"layout": "ring"},
        scanner=vars(
            ScannerConfig(
                rays=181, field_of_view_deg=180.0, range_max_m=8.0, scan_period_s=0.2, noise_m=0.02, resolution_m=0.001
            )
        ),
        wheels=vars(WheelsConfig(left_bias=0.03, right_bias=-0.01)),
    ),
    "scan_drawn_1": Building(900_000_101, scanner=_FEW, driver={"driver": "any"}),
    "scan_drawn_2": Building(900_000_120, scanner=_FEW, driver={"driver": "any"}),
    "scan_drawn_3": Building(900_000_141, scanner=_FEW, driver={"driver": "any"}),
    "scan_slips": _building(900_000_162, wheels={"slips_per_km": 300.0}),
    "scan_freezes": _building(900_000_181, wheels={"freezes_per_hour": 400.0}),
    "scan_jumps": _building(900_000_201, wheels={"jumps_per_hour": 400.0}),
    "scan_lag": _building(900_000_220, {"sweep": 0.9}, {"lag_s": 0.15}),
    "scan_no_wheels": _building(900_000_240, with_wheels=False),
    "scan_corridor": _building(
        900_000_260, {"range_max_m": 6.0}, plan={"layout": "wings", "scale": 0.7, "clutter": 0.0, "glass": 0.0}
    ),
    "scan_standing": _building(900_000_280, plan={"people": 4}, driver={"stand": 1.0, "spin": 1.0}),
    "scan_narrow": _building(900_000_300, {"field_of_view_deg": 90.0, "rays": 91}),
    "scan_sweeping": _building(
        900_000_320,
        {"field_of_view_deg": 360.0, "sweep": 1.0},
        driver={"turn_rate_rps": 2.0, "spin": 1.0},
        with_wheels=False,
    ),
    "scan_noisy": _building(900_000_340, {"noise_m": 0.03, "noise_per_m": 0.01, "dropout": 0.1}),
    "scan_people": _building(900_000_360, plan={"people": 20}),
    "scan_short": _building(900_000_380, {"range_max_m": 4.0, "field_of_view_deg": 240.0}),
    "scan_aliased": _building(900_000_400, plan={"aliased": True, "layout": "ladder"}),
    "scan_mounting": _building(
        900_000_420,
        {"laser_yaw_deg": 90.0, "upside_down": True, "clockwise": True, "laser_x_m": 0.15, "laser_y_m": 0.05},
    ),
}


@dataclass(frozen=True)
class Maze:
    """A drive of a camera: ``frames`` frames in the maze of ``world`` and ``seed``, or on a Doom map.

    ``driver`` None is the world's. Of bytes ``bits`` are kept, so that files are small: errors hardly change.
    """

    world: str
    seed: int
    frames: int
    rows: int = 5
    extra_openings: int = 4
    driver: str | None = None
    doom_map: tuple[str, str] | None = None
    bits: int = 4

    def make(self) -> GoldenDrive:
        """Drive through the maze or the map."""
        world = world_named(self.world)
        episode = self._episode(world)
        images = images_of(world, episode).numpy()
        if images.dtype == np.uint8:
            left = 8 - self.bits
            images = (images >> left << left) | (1 << left >> 1)
        period_ns = np.array(round(world.period_s * 1e9))
        return GoldenDrive(self.world, images, episode.actions, period_ns, seen_from_first(episode.poses_xyyaw))

    def _episode(self, world: World) -> Episode:
        if self.doom_map is not None:
            drawn_start = self.doom_map not in (ROOMS, MAZES)
            return map_drive(self.doom_map, self.seed, self.frames, drawn_start=drawn_start)
        environment = world.make(self.rows, self.extra_openings)
        try:
            return record_episode(environment, self.driver or world.driver, self.frames, self.seed)
        finally:
            environment.close()


CAMERA_DRIVES = {
    "maze2d": Maze("maze2d", 900_000_001, 320),
    "maze2d_2": Maze("maze2d", 900_000_010, 240),
    "maze2d_3": Maze("maze2d", 900_000_011, 240),
    "maze2d_4": Maze("maze2d", 900_000_012, 240),
    "maze3d": Maze("maze3d", 900_000_001, 208, bits=5),
    "maze3d_2": Maze("maze3d", 900_000_010, 112, 3, 2),
    "maze3d_3": Maze("maze3d", 900_000_012, 112, 3, 2),
    "maze3d_4": Maze("maze3d", 900_000_011, 112, 3, 2, driver="learned"),
    "doom_1": Maze("doom", 900_000_011, 112, doom_map=ROOMS),
    "doom_2": Maze("doom", 900_000_013, 144, doom_map=ROOMS),
    "doom_3": Maze("doom", 900_000_012, 144, doom_map=MAZES),
    # A map that chose settings, from another start.
    "doom_4": Maze("doom", 900_000_020, 144, doom_map=VALIDATION_MAPS[0]),
}

if __name__ == "__main__":
    drives: dict[str, Building | Maze] = {**LIDAR_DRIVES, **CAMERA_DRIVES}
    for name in sys.argv[1:] or drives:
        drives[name].make().save(name)
