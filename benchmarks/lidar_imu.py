"""What an IMU is worth to a lidar whose wheels slip, and what a wrong one costs: buildings of the simulation.

    python -m benchmarks.lidar_imu --seeds 10000 10001 10002 10003 10004

Each row is one way to have or to spoil the IMU. The last line is a JSON object of the same numbers.
"""

import json
import math
from dataclasses import dataclass, replace

import numpy as np
import tyro

from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import between
from ngo_estimator.offline.lidar_run import LidarRecord, LidarRun
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import ImuReading, LidarScan
from ngo_sim.building2d import Building2d, BuildingDrive
from ngo_sim.floor_plans import FloorPlanConfig
from training.data.building_drives import lidar_drive
from training.data.lidar_drives import TruePoses, simulated_stamps_ns

_RATE_HZ = 100.0
_NOISE_RPS, _BIAS_RPS = 0.005, 0.02  # Deviation and bias of a cheap gyroscope's reading.

VARIANTS = ("none", "right", "wrong sign", "0.1 s late", "0.3 s late", "noise alone")


@dataclass(frozen=True)
class Arguments:
    """What is driven."""

    seeds: tuple[int, ...] = (10_000, 10_001, 10_002, 10_003, 10_004)
    """Buildings, each with the scanner and the wheels that are drawn for it."""
    scans: int = 600  # Scans of each drive.
    slips_per_km: float = 300.0  # How often the wheels slip.


def main(arguments: Arguments) -> int:
    """Print the mean error of each variant, and how many drives it made worse."""
    found: dict[str, list[tuple[float, float, bool]]] = {name: [] for name in VARIANTS}
    for seed in arguments.seeds:
        building = Building2d(FloorPlanConfig())
        building.reset(seed)
        wheels = replace(building.wheels, slips_per_km=arguments.slips_per_km)
        drive = Building2d(FloorPlanConfig(), wheels=wheels).record(seed, 10_000.0, arguments.scans)
        for name in VARIANTS:
            found[name].append(_errors(drive, name))
            print(seed, name, *found[name][-1], flush=True)
    table = {name: np.array([(odometry, path) for odometry, path, _ in rows]) for name, rows in found.items()}
    print(f"means of {len(arguments.seeds)} drives")
    print(f"{'IMU':14} {'odometry (m)':>14} {'corrected (m)':>14} {'worse':>6} {'used':>5}")
    for name, errors in table.items():
        worse = int((errors[:, 1] > 1.1 * table["none"][:, 1]).sum())
        used = sum(used for *_, used in found[name])
        print(f"{name:14} {errors[:, 0].mean():14.4f} {errors[:, 1].mean():14.4f} {worse:6d} {used:5d}")
    print(json.dumps({name: errors.tolist() for name, errors in table.items()}))
    return 0


def _errors(drive: BuildingDrive, variant: str) -> tuple[float, float, bool]:
    """RMSE of the odometry and of the corrected path (m), and whether the IMU was used at the end."""
    made = lidar_drive(drive, "", "")
    assert isinstance(made.reference, TruePoses)
    imu = [] if variant == "none" else _imu(drive, variant)
    together: list[LidarRecord] = [*made.wheels, *imu, *made.scans]
    records = sorted(together, key=_order)
    run = LidarRun(MixtureLidar(), ScanTrajectory(iterations_per_step=1), made.mounting)
    run.learn(records)
    events = list(run.run(records))
    path = next(event for event in events if isinstance(event, RecordedRun)).trajectory
    odometry = np.array([event.local.odom_xyyaw for event in events if isinstance(event, RecordedStep)])
    true = made.reference.poses_xyyaw
    at = np.searchsorted(made.reference.stamps_ns, path.stamps_ns)
    expected = np.array([between(true[at[0]], true[k]) for k in at])[:, :2]
    errors = [
        math.sqrt(float(((poses[:, :2] - expected[-len(poses) :]) ** 2).sum(axis=1).mean()))
        for poses in (odometry, path.poses_xyyaw)
    ]
    return errors[0], errors[1], any("stand in for" in line for line in run.remarks())


def _order(record: LidarRecord) -> tuple[int, bool]:
    return record.stamp_ns, isinstance(record, LidarScan)


def _imu(drive: BuildingDrive, variant: str) -> list[ImuReading]:
    """Readings by the clock of the wheels."""
    noise = np.random.default_rng(7)
    times = np.arange(drive.stamps_s[0], drive.stamps_s[-1], 1.0 / _RATE_HZ)
    index = np.searchsorted(drive.stamps_s, times, side="right") - 1
    rates = drive.twists[index, 1] * (-1.0 if variant == "wrong sign" else 1.0)
    rates = rates * (variant != "noise alone") + _BIAS_RPS + noise.normal(0.0, _NOISE_RPS, len(times))
    late_s = (float(variant[:3]) if variant.endswith("late") else 0.0) - drive.wheels.lag_s
    stamps_ns = simulated_stamps_ns(times + late_s)
    return [ImuReading(stamp_ns, rate) for stamp_ns, rate in zip(stamps_ns.tolist(), rates.tolist(), strict=True)]


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Arguments, description=__doc__)))
