"""Drives of several robots through one building at the same time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from ngo_sim.building2d import Building2d, BuildingDrive
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from training.data.building_drives import lidar_drive
from training.data.lidar_drives import LidarDrive

_FAR_M = 100_000.0
_RAYS = 360
RATE_HZ = 10.0
"""Scans a second of each robot."""


def fleet_drives(seed: int, robots: int, scans: int, aliased: bool = False) -> tuple[LidarDrive, ...]:
    """Drives of ``scans`` each through the building of ``seed``, from other starts and on other ways.

    All robots have the scanner that is drawn for the building, with 360 rays ten times a second, and begin at one time.
    Doors and people are each robot's own: the robots do not see each other.
    """
    plan = FloorPlanConfig(aliased=aliased)
    building = Building2d(plan, patrol_scanner(seed, plan))
    kind = "aliased" if aliased else "building"
    return tuple(
        lidar_drive(
            _from_now_on(building.record(seed, _FAR_M, scans, drive=robot)),
            f"{kind}_{seed}_robot_{robot}",
            f"building seed {seed}, aliased {aliased}, {scans} scans, robot {robot}",
        )
        for robot in range(robots)
    )


@cache
def patrol_scanner(seed: int, plan: FloorPlanConfig) -> ScannerConfig:
    """The scanner that is drawn for a building, with 360 rays ten times a second."""
    drawn = Building2d(plan)
    drawn.reset(seed)
    return replace(drawn.scanner, rays=_RAYS, scan_period_s=1.0 / RATE_HZ)


def _from_now_on(drive: BuildingDrive) -> BuildingDrive:
    """A drive that begins at the time 0."""
    first_s = float(drive.stamps_s[0])
    return replace(drive, stamps_s=drive.stamps_s - first_s, wheel_stamps_s=drive.wheel_stamps_s - first_s)
