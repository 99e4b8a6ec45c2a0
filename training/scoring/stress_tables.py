"""The tables of stress beside the one of logs: which drives, which rows, and which of their numbers count."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

from ngo_recordings import mounting, recording, scan_stream, topics
from ngo_sim import building2d
from training.data import building_drives, lidar_changes
from training.data.building_drives import building_drive, poor_wheels_drive, two_buildings
from training.data.lidar_changes import CHANGES, changed
from training.data.lidar_drives import LidarDrive
from training.data.sensor_log import FAR_AWAY_M, SensorLog
from training.recordings import lidar_logs
from training.recordings.lidar_logs import log_identity, read_drive
from training.scoring.lidar_rows import ROWS, Row
from training.scoring.stress_rows import join_row, loop_facts, visit_facts, with_facts
from training.scoring.table import Drive

_MOST_SCANS = 6000  # of a short drive: some robots stand for minutes
_MOST_SCANS_LONG = 20_000
_PAUSE_S = 20.0
_READ = (mounting, recording, scan_stream, topics, lidar_logs)
_SIMULATED = (building2d, building_drives, lidar_changes)


@dataclass(frozen=True)
class StressTable:
    """Drives by the name of their group, the rows of each drive, and the keys of the numbers that are published."""

    groups: Mapping[str, Sequence[Drive]]
    rows: Mapping[str, Row]
    keys: Sequence[str]


@dataclass(frozen=True)
class Size:
    """``first`` seed, how many ``drives`` in each group, and a ``factor`` on the length of each."""

    first: int
    drives: int
    factor: float


def buildings(size: Size) -> StressTable:
    """150 m in each of some buildings after each change, where the truth is known at each scan."""
    length_m, seeds = 150.0 * size.factor, range(size.first, size.first + size.drives)
    groups = {
        change: [_source(f"{change}_{seed}", size, partial(_changed, change, seed, length_m)) for seed in seeds]
        for change in CHANGES
    }
    rows = {name: ROWS[name] for name in ("wheels", "ours", "ours_without_wheels")}
    return StressTable(groups, rows, ("ate_m", "position_rmse_m", "heading_rmse_deg", "within_three_deviations"))


def loops(size: Size) -> StressTable:
    """1 km in each of some buildings with poor wheels: are loops closed, however far the wheels are off?"""
    length_m, first = 1000.0 * size.factor, size.first + 1000
    sources = [
        _source(f"poor_wheels_{seed}", size, partial(poor_wheels_drive, seed, length_m, _MOST_SCANS_LONG))
        for seed in range(first, first + size.drives)
    ]
    rows = {name: with_facts(name, loop_facts) for name in ("wheels", "ours", "ours_without_wheels")}
    return StressTable({"poor_wheels": sources}, rows, ("ate_m", "odometry_ate_m", "largest_m", "last_loop_m"))


def joins(size: Size) -> StressTable:
    """Drives where loops tend to be wrong: 200 m among rooms that look alike, and 100 m in each of two buildings.

    In 100 m and 100 m more of one building, from another start, the robot is to be found again.
    """
    length_m, first = 100.0 * size.factor, size.first + 2000
    aliased = [
        _source(f"aliased_{seed}", size, partial(building_drive, seed, 2.0 * length_m, True, _MOST_SCANS))
        for seed in range(first, first + size.drives)
    ]
    halves = [
        _source(f"two_buildings_{seed}", size, partial(_put_together, (seed, seed + 1000), length_m))
        for seed in range(first + 1000, first + 1000 + size.drives)
    ]
    again = [
        _source(f"same_building_{seed}", size, partial(_put_together, (seed, seed), length_m))
        for seed in range(first + 3000, first + 3000 + size.drives)
    ]
    groups = {"aliased": aliased, "two_buildings": halves, "same_building": again}
    return StressTable(groups, {"ours": join_row()}, ("loops", "wrong_loops", "wrong_believed", "lost_at_end"))


def car(path: Path) -> StressTable:
    """A recording whose end lies on its way: how far is the second visit from the first?"""
    source = Drive(path.name.partition(".")[0], log_identity(path), partial(read_drive, path), _READ)
    rows = {name: with_facts(name, visit_facts) for name in ("wheels", "ours", "ours_without_wheels")}
    keys = ("metres", "degrees", "share", "share_before")
    return StressTable({source.name: [source]}, rows, [f"second_visit_{key}" for key in keys])


def _source(name: str, size: Size, make: Callable[[], LidarDrive]) -> Drive:
    return Drive(name, f"{name}, factor {size.factor:g} on the length", make, _SIMULATED)


def _changed(change: str, seed: int, length_m: float) -> LidarDrive:
    name = f"{change}_{seed}"
    return changed(_building(seed, length_m), change, seed).drive(name, name)


@lru_cache(maxsize=1)
def _building(seed: int, length_m: float) -> SensorLog:
    return SensorLog.of_drive(building_drive(seed, length_m, most_scans=_MOST_SCANS))


def _put_together(seeds: tuple[int, int], length_m: float) -> LidarDrive:
    one, other = map(SensorLog.of_drive, two_buildings(seeds, length_m, _MOST_SCANS // 2))
    same = seeds[0] == seeds[1]
    name = f"{'same_building' if same else 'two_buildings'}_{seeds[0]}"
    return one.followed_by(other, _PAUSE_S, 0.0 if same else FAR_AWAY_M).drive(name, name)
