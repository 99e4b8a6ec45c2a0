"""What two lidars, a 3D lidar and depth cameras are worth beside a lidar, and whether the covariance holds for them.

    python -m benchmarks.lidar_depth --seeds 30000 30001 30002 30003 30004

Buildings of the simulation, and wheels that have a bias. Errors of depth grow with its square; those of neighbouring
pixels are independent. Of steps between key scans the squared errors by their covariance are 1 in the mean where it is
right, and more where it is too small. The last line is a JSON object of the same numbers.
"""

import json
import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import tyro

from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import Array, between, wrap
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.offline.lidar_run import LidarRecord, LidarRun
from ngo_estimator.offline.recorded import RecordedStep
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import LidarScan
from ngo_recordings.space_scan import cloud_scan
from ngo_sim.building2d import Building2d
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.wheels import WheelsConfig
from training.data.building_drives import lidar_drive
from training.data.lidar_drives import LidarDrive, TruePoses


@dataclass(frozen=True)
class Sensor:
    """What sees: ``growth`` is the deviation of a range per its square (1/m), ``rear`` a second one that looks back."""

    field_of_view_deg: float = 87.0
    rays: int = 320
    farthest_m: float = 5.0
    noise_m: float = 0.002
    growth: float = 0.0
    rear: bool = False
    rings: int = 0


SENSORS = {
    "lidar, 360 degrees": (_ROUND := Sensor(360.0, 720, 12.0, 0.01)),
    "PointCloud2, 16 rings": replace(_ROUND, rings=16),
    "lidar, 180 degrees": (_AHEAD := Sensor(180.0, 360, 12.0, 0.01)),
    "two of these, front and rear": replace(_AHEAD, rear=True),
    "87 degrees, 2 mm": Sensor(),
    "depth, 4 cm at 5 m": Sensor(growth=0.0016),
    "stereo, 12 cm at 5 m": Sensor(farthest_m=10.0, growth=0.005),
}

_HEIGHT_M = 0.5  # Of a 3D lidar above the floor.

WHEELS = WheelsConfig(left_bias=0.02, slips_per_km=60.0)


@dataclass(frozen=True)
class Arguments:
    """What is driven."""

    seeds: tuple[int, ...] = (30_000, 30_001, 30_002, 30_003, 30_004)  # Buildings.
    scans: int = 200  # Scans of each drive.


def main(arguments: Arguments) -> int:
    """Print the errors of each sensor, and how its covariance holds."""
    found: dict[str, list[tuple[float, float]]] = {}
    for name, sensor in SENSORS.items():
        for seed in arguments.seeds:
            drives = [_drive(seed, arguments.scans, sensor, yaw) for yaw in ((0.0, 180.0) if sensor.rear else (0.0,))]
            found.setdefault(name, []).append(_errors(drives))
            print(seed, name, *found[name][-1], flush=True)
    print(f"{len(arguments.seeds)} drives: mean, least and largest RMSE of the odometry (m), and of squared errors")
    for name, rows in found.items():
        each = [f"{numbers.mean():.4f} {numbers.min():.4f} {numbers.max():.4f}" for numbers in np.array(rows).T]
        print(f"{name:30} {each[0]}   {each[1]}")
    print(json.dumps(found))
    return 0


def _drive(seed: int, count: int, sensor: Sensor, yaw_deg: float) -> LidarDrive:
    """A drive whose scans are of the frame ``str(yaw_deg)``; it is the same one for each sensor."""
    scanner = ScannerConfig(
        rays=sensor.rays, field_of_view_deg=sensor.field_of_view_deg, range_max_m=sensor.farthest_m, sweep=0.0,
        noise_m=sensor.noise_m, noise_per_m=0.0,
        laser_x_m=-0.1 if yaw_deg else 0.1, laser_y_m=0.0, laser_yaw_deg=yaw_deg,
    )  # fmt: skip
    drive = lidar_drive(Building2d(FloorPlanConfig(), scanner, WHEELS).record(seed, 10_000.0, count), "", "")
    noise = np.random.default_rng(seed)
    scans = []
    for scan in drive.scans:
        deviations = sensor.growth * np.where(np.isfinite(scan.ranges), scan.ranges, 0.0) ** 2
        ranges = scan.ranges + deviations * noise.standard_normal(len(scan.ranges))
        seen = replace(scan, ranges=ranges.astype(np.float32), frame_id=str(yaw_deg))
        scans.append(_of_cloud(seen, sensor.rings) if sensor.rings else seen)
    return replace(drive, scans=tuple(scans))


def _of_cloud(scan: LidarScan, rings: int) -> LidarScan:
    """The scan in a PointCloud2 of walls that stand upright, and of the floor before them."""
    tangents = np.tan(np.radians(np.linspace(-15.0, 15.0, rings)))[:, None]
    floor = np.where(tangents < 0.0, _HEIGHT_M / np.maximum(-tangents, 1e-9), np.inf)
    reach = np.minimum(np.where(np.isfinite(scan.ranges), scan.ranges, np.nan), floor)
    points = np.stack([reach * np.cos(scan.angles), reach * np.sin(scan.angles), reach * tangents], axis=-1)
    fields = [SimpleNamespace(name=name, offset=4 * k, datatype=7, count=1) for k, name in enumerate("xyz")]
    stamp = SimpleNamespace(sec=scan.stamp_ns // 10**9, nanosec=scan.stamp_ns % 10**9)
    header = SimpleNamespace(stamp=stamp, frame_id=scan.frame_id)
    message = SimpleNamespace(
        header=header, fields=fields, height=rings, width=len(scan.ranges), point_step=12,
        row_step=12 * len(scan.ranges), is_bigendian=False, data=points.astype("<f4").tobytes(),
    )  # fmt: skip
    return cloud_scan(message, "points")


def _errors(drives: list[LidarDrive]) -> tuple[float, float]:
    """RMSE of the odometry (m), and the mean squared error of steps between key scans by their covariance, 1 where that
    is right; by the scanners of all ``drives``, which are one."""
    drive = drives[0]
    assert isinstance(drive.reference, TruePoses)
    together: list[LidarRecord] = [*drive.wheels, *(scan for each in drives for scan in each.scans)]
    records = sorted(together, key=lambda record: (record.stamp_ns, isinstance(record, LidarScan)))
    mountings: dict[str, Mounting] = {each.scans[0].frame_id: each.mounting for each in drives}
    run = LidarRun(MixtureLidar(), ScanTrajectory(iterations_per_step=1), mountings.get)
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
