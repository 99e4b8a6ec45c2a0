"""Whether the covariance holds for ranges whose errors grow with their square, as those of depth cameras do.

    python -m benchmarks.lidar_depth --seeds 30000 30001 30002 30003 30004

Cameras of 87 degrees in buildings of the simulation, with wheels that have a bias. Errors of neighbouring pixels are
independent. Of steps between key scans the squared errors by their covariance are 1 in the mean where it is right, and
more where it is too small. The last line is a JSON object of the same numbers.
"""

import json
import math
from dataclasses import dataclass, replace

import numpy as np
import tyro

from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import Array, between, wrap
from ngo_estimator.offline.lidar_run import LidarRecord, LidarRun
from ngo_estimator.offline.recorded import RecordedStep
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import LidarScan
from ngo_sim.building2d import Building2d
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.wheels import WheelsConfig
from training.data.building_drives import lidar_drive
from training.data.lidar_drives import LidarDrive, TruePoses

CAMERAS = {"as a lidar": (0.0, 5.0), "depth, 4 cm at 5 m": (0.0016, 5.0), "stereo, 12 cm at 5 m": (0.005, 10.0)}
"""Deviation of depth per its square (1/m), and the farthest range (m)."""

WHEELS = WheelsConfig(left_bias=0.02, slips_per_km=60.0)


@dataclass(frozen=True)
class Arguments:
    """What is driven."""

    seeds: tuple[int, ...] = (30_000, 30_001, 30_002, 30_003, 30_004)
    """Buildings."""
    scans: int = 200
    """Scans of each drive."""


def main(arguments: Arguments) -> int:
    """Print the errors of each camera, and how its covariance holds."""
    found: dict[str, list[tuple[float, float]]] = {}
    for name, (growth, farthest_m) in CAMERAS.items():
        for seed in arguments.seeds:
            drive = _drive(seed, arguments.scans, growth, farthest_m)
            found.setdefault(name, []).append(_errors(drive))
            print(seed, name, *found[name][-1], flush=True)
    print(f"{len(arguments.seeds)} drives: mean, least and largest RMSE of the odometry (m), and of squared errors")
    for name, rows in found.items():
        each = [f"{numbers.mean():.4f} {numbers.min():.4f} {numbers.max():.4f}" for numbers in np.array(rows).T]
        print(f"{name:22} {each[0]}   {each[1]}")
    print(json.dumps(found))
    return 0


def _drive(seed: int, count: int, growth: float, farthest_m: float) -> LidarDrive:
    scanner = ScannerConfig(
        rays=320, field_of_view_deg=87.0, range_max_m=farthest_m, sweep=0.0, noise_m=0.002, noise_per_m=0.0,
        laser_x_m=0.1, laser_y_m=0.0, laser_yaw_deg=0.0,
    )  # fmt: skip
    drive = lidar_drive(Building2d(FloorPlanConfig(), scanner, WHEELS).record(seed, 10_000.0, count), "", "")
    noise = np.random.default_rng(seed)
    scans = []
    for scan in drive.scans:
        deviations = growth * np.where(np.isfinite(scan.ranges), scan.ranges, 0.0) ** 2
        ranges = scan.ranges + deviations * noise.standard_normal(len(scan.ranges))
        scans.append(replace(scan, ranges=ranges.astype(np.float32)))
    return replace(drive, scans=tuple(scans))


def _errors(drive: LidarDrive) -> tuple[float, float]:
    """RMSE of the odometry (m), and the mean squared error of steps between key scans by their covariance, 1 where that
    is right."""
    assert isinstance(drive.reference, TruePoses)
    together: list[LidarRecord] = [*drive.wheels, *drive.scans]
    records = sorted(together, key=lambda record: (record.stamp_ns, isinstance(record, LidarScan)))
    run = LidarRun(MixtureLidar(), ScanTrajectory(iterations_per_step=1), drive.mounting)
    steps = [event.local for event in run.run(records) if isinstance(event, RecordedStep)]
    stamps, true = drive.reference.stamps_ns, drive.reference.poses_xyyaw

    def at(stamp_ns: int) -> Array:
        pose: Array = true[int(np.searchsorted(stamps, stamp_ns))]
        return pose

    start, squares = at(steps[0].from_stamp_ns), []
    off = np.array([step.odom_xyyaw - between(start, at(step.stamp_ns)) for step in steps])
    for step in steps:
        if step.key is not None:
            moved = between(at(step.key.from_key_stamp_ns), at(step.stamp_ns))
            error = step.key.relative_xyyaw - moved
            error[2] = wrap(error[2])
            squares.append(float(error @ np.linalg.solve(step.key.covariance, error)) / 3.0)
    return math.sqrt(float((off[:, :2] ** 2).sum(axis=1).mean())), float(np.mean(squares))


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Arguments, description=__doc__)))
