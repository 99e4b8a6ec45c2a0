"""Drives of one robot through a building that changes: furniture is moved between drives, and doors move."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ngo_sim.building2d import Building2d, BuildingDrive
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import cast_scans, ray_world
from training.data.building_drives import lidar_drive
from training.data.fleet_drives import patrol_scanner
from training.data.lidar_drives import LidarDrive, simulated_stamps_ns

_FAR_M = 100_000.0


@dataclass(frozen=True, eq=False)
class YearDrive:
    """A drive as it was measured, and the building as it was then."""

    measured: LidarDrive
    building: BuildingDrive

    def exact_scans(self, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a scanner without errors would see of the building as it is now from poses ``(n, 3)``, without people.

        Doors are as they were at the stamps ``(n,)``: they decide on what is seen, and not on what is there.

        Returns directions ``(rays,)`` from the robot, ranges ``(n, rays)`` and the scanner's pose ``(3,)`` on the
        robot. It sees through glass.
        """
        plan, drive = self.building.plan, self.building
        scanner = replace(
            drive.scanner, noise_m=0.0, noise_per_m=0.0, dropout=0.0, glass_seen=0.0, glass_lost=0.0, resolution_m=0.0,
            no_return="inf", sweep=0.0,
        )  # fmt: skip
        swing = np.column_stack((plan.doors.hinges_m, plan.doors.widths_m))
        world = ray_world(plan.segments_m, plan.glass, plan.circles_m, swing)
        count = len(poses_xyyaw)
        leaves = plan.doors.leaves(1e-9 * (stamps_ns - simulated_stamps_ns(np.zeros(1))))
        nobody, rng = np.zeros((count, 0, 3)), np.random.default_rng(0)
        ranges = cast_scans(world, scanner, poses_xyyaw, np.zeros((count, 2)), leaves, nobody, rng)
        at = np.array((scanner.laser_x_m, scanner.laser_y_m, 0.0))
        return scanner.base_angles_rad(), ranges, at


def year_drive(seed: int, number: int, scans: int) -> YearDrive:
    """The drive of a number, from 0 on, of ``scans`` through the building of ``seed``.

    Before each drive but the first, one piece of furniture in twenty is moved. Stamps go on through the year. Each
    drive has another start and another way; the robot, its wheels and its scanner with 360 rays stay.
    """
    building = Building2d(FloorPlanConfig(furniture_moves=number), patrol_scanner(seed, FloorPlanConfig()))
    drive = building.record(seed, _FAR_M, scans, drive=number)
    words = f"building seed {seed}, drive {number} of a year, {scans} scans"
    return YearDrive(lidar_drive(drive, f"year_{seed}_{number}", words), drive)
