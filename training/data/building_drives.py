"""Simulated drives of a lidar through buildings, with wheels that nobody calibrated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from ngo_sim.building2d import Building2d, BuildingDrive
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.wheels import WheelsConfig
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
    plan = FloorPlanConfig(aliased=aliased)
    building = Building2d(plan)
    if slips_per_km is not None:
        building.reset(seed)
        building = Building2d(plan, wheels=replace(building.wheels, slips_per_km=slips_per_km))
    return lidar_drive(
        building.record(seed, length_m, most_scans),
        f"{'aliased' if aliased else 'building'}_{seed}",
        f"building seed {seed}, aliased {aliased}, {length_m:g} m, at most {most_scans} scans, slips {slips_per_km}",
    )


def poor_wheels_drive(seed: int, length_m: float, most_scans: int = 100_000) -> LidarDrive:
    """The same with wheels that drift by as much as the building is large: uneven, slipping, freezing and jumping.

    Scanners that are faster take 10 scans a second.
    """
    rng = np.random.default_rng((seed, 3))
    common, apart = rng.normal(0.0, 0.03), rng.choice((-1.0, 1.0)) * rng.uniform(0.0002, 0.001)
    wheels = WheelsConfig(
        left_bias=float(np.clip(common + apart, -0.2, 0.2)),
        right_bias=float(np.clip(common - apart, -0.2, 0.2)),
        wheel_noise=0.01,
        slips_per_km=60.0,
        freezes_per_hour=40.0,
        jumps_per_hour=10.0,
        lag_s=float(rng.uniform(0.0, 0.2)),
    )
    building = Building2d(FloorPlanConfig())
    building.reset(seed)
    scanner = replace(building.scanner, scan_period_s=max(building.scanner.scan_period_s, 0.1))
    drive = Building2d(FloorPlanConfig(), scanner, wheels).record(seed, length_m, most_scans)
    words = f"building seed {seed}, poor wheels, {length_m:g} m, at most {most_scans} scans"
    return lidar_drive(drive, f"poor_wheels_{seed}", words)


def two_buildings(seeds: tuple[int, int], length_m: float, most_scans: int = 100_000) -> tuple[LidarDrive, LidarDrive]:
    """A drive of ``length_m`` through each of two buildings, by the scanner and the wheels that the first one draws.

    Of one seed, it is another drive through the same building: another start, another way, doors as they are then.
    """
    first = Building2d(FloorPlanConfig())
    drives = [first.record(seeds[0], length_m, most_scans)]
    again = Building2d(FloorPlanConfig(), first.scanner, first.wheels)
    drives.append(again.record(seeds[1], length_m, most_scans, drive=int(seeds[0] == seeds[1])))
    words = f"scanner of {seeds[0]}, {length_m:g} m, at most {most_scans} scans"
    one, other = (
        lidar_drive(drive, f"building_{seed}", f"building seed {seed}, {words}")
        for drive, seed in zip(drives, seeds, strict=True)
    )
    return one, other


def lidar_drive(drive: BuildingDrive, name: str, identity: str) -> LidarDrive:
    """What a robot measured on a drive, as a recording has it."""
    scanner = drive.scanner
    stamps_ns = simulated_stamps_ns(drive.stamps_s)
    scans = tuple(
        measured_scan(scanner, stamp_ns, ranges)
        for stamp_ns, ranges in zip(stamps_ns.tolist(), drive.ranges_m, strict=True)
    )
    wheels = tuple(map(WheelPose, simulated_stamps_ns(drive.wheel_stamps_s).tolist(), drive.wheel_poses_xyyaw))
    pose = np.array((scanner.laser_x_m, scanner.laser_y_m, math.radians(scanner.laser_yaw_deg)))
    truth = TruePoses(stamps_ns, drive.true_poses_xyyaw)
    return LidarDrive(name, identity, scans, wheels, Mounting(pose, scanner.upside_down), truth)


def measured_scan(scanner: ScannerConfig, stamp_ns: int, ranges: np.ndarray) -> LidarScan:
    """The ranges ``(rays,)`` of a simulated scanner as its driver publishes them."""
    return LidarScan(
        stamp_ns,
        float(scanner.angles_rad[0]),
        scanner.increment_rad * (1.0 + scanner.increment_error),
        ranges,
        scanner.range_min_m,
        scanner.range_max_m,
        scanner.time_increment_s,
        _FRAME,
    )
