"""Simulated drives of a lidar through buildings, with wheels that nobody calibrated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from ngo_sim.building2d import Building2d
from ngo_sim.floor_plans import FloorPlanConfig
from training.data.lidar_drives import LidarDrive, TruePoses, simulated_stamps_ns

BUILDING_TEST_SEEDS = range(20_000, 30_000)
"""Buildings for final tables; what learns takes seeds below 10,000, what chooses settings those between."""

_FRAME = "laser"


def building_drive(
    seed: int,
    length_m: float,
    aliased: bool = False,
    most_scans: int = 100_000,
    slips_per_km: float | None = None,
) -> LidarDrive:
    """A drive of ``length_m`` through the building of ``seed``, by the scanner and the wheels that are drawn for it.

    With ``slips_per_km`` the wheels slip so often; all else is as drawn.
    """
    building = Building2d(FloorPlanConfig(aliased=aliased))
    if slips_per_km is not None:
        building.reset(seed)
        building = Building2d(
            FloorPlanConfig(aliased=aliased), wheels=replace(building.wheels, slips_per_km=slips_per_km)
        )
    drive = building.record(seed, length_m, most_scans)
    scanner = drive.scanner
    increment = scanner.increment_rad * (1.0 + scanner.increment_error)
    stamps_ns = simulated_stamps_ns(drive.stamps_s)
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
    wheels = tuple(map(WheelPose, simulated_stamps_ns(drive.wheel_stamps_s).tolist(), drive.wheel_poses_xyyaw))
    pose = np.array((scanner.laser_x_m, scanner.laser_y_m, math.radians(scanner.laser_yaw_deg)))
    return LidarDrive(
        f"{'aliased' if aliased else 'building'}_{seed}",
        f"building seed {seed}, aliased {aliased}, {length_m:g} m, at most {most_scans} scans, slips {slips_per_km}",
        scans,
        wheels,
        Mounting(pose, scanner.upside_down),
        TruePoses(stamps_ns, drive.true_poses_xyyaw),
    )
