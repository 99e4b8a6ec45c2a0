"""Make the table of relocalisation: kidnapped starts in mapped mazes, by one command.

    python -m training.relocalisation
    python -m training.relocalisation --tables --logs FOLDER    # real logs alone

In each maze one drive makes a map, by the whole online system. Robots start at frames of another drive, with other
starts, noise and driver, and know nothing but the map. Mazes are those that nothing was trained or chosen on; aliased
ones repeat one module with one texture. Writes ``training/results/relocalisation.json`` and
``docs/results_relocalisation.md``. Run it again to continue after a stop.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from ngo_estimator.frontend.lidar import mixture_lidar
from ngo_estimator.loops import pair_measurement
from ngo_estimator.slam import localisation, online_trajectory, place_matcher, scan_matcher, scan_trajectory
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.common.command_line import check_at_least, run_command
from training.data.batches import seen_from_first
from training.data.kidnapped_drives import Features, kidnapped_drives
from training.data.lidar_drives import LidarDrive
from training.data.worlds import WORLDS, World
from training.recordings import lidar_logs
from training.recordings.lidar_logs import log_identity, logs_below, read_drive
from training.report import relocalisation_page
from training.report.folders import Folders
from training.scoring import kidnapped, kidnapped_logs, online_estimate, relocalisation_rows
from training.scoring.kidnapped import NUMBERS, KnownMap, MapErrors, scored, starts
from training.scoring.kidnapped_logs import as_arrays, log_starts, starts_of, summary_of
from training.scoring.metrics import off_by, rms
from training.scoring.online_estimate import run_online
from training.scoring.relocalisation_rows import ROWS, Networks, RowName, row_of
from training.scoring.table import (
    Drive,
    Measured,
    Numbers,
    Row,
    column,
    folder_digest,
    interval_of,
    intervals,
    means_over_samples,
    measure,
)


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the table."""

    tables: tuple[Literal["maze2d", "maze3d", "maze2d_aliased", "maze3d_aliased"], ...] = (
        "maze2d",
        "maze3d",
        "maze2d_aliased",
        "maze3d_aliased",
    )
    """Tables to measure; none: those in the JSON stay as they are, for the logs alone."""
    split: Literal["validation", "test"] = "test"
    """Mazes to measure in. Thresholds are chosen on validation; the test split is for the final table alone."""
    mazes: int = 10  # Mazes of each table.
    starts: int = 50
    """Starts in mapped parts of each maze; up to a fifth as many more are taken in parts without a map."""
    aliased_starts: int = 20  # The same in each aliased maze.
    rows: tuple[RowName, ...] = ROWS  # Rows to measure.
    logs: Path | None = None
    """Folder of real logs of a lidar (.bag, .log, .clf, gzipped or not); none: they stay as the JSON has them."""
    log_starts: int = 20  # Starts in each log.

    def __post_init__(self) -> None:
        check_at_least(self, mazes=2, starts=2, aliased_starts=2)


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write the JSON, and return its content."""
    result, made = arguments.published("relocalisation") or {"tables": {}, "logs": {}}, arguments.made("relocalisation")
    if arguments.tables:
        found = {table: measured(arguments, table) for table in arguments.tables}
        kinds = {"tables": "mapped", "unmapped": "unmapped", "maps": "maps"}
        result = {
            **made,
            **{name: getattr(arguments, name) for name in ("split", "mazes", "starts", "aliased_starts")},
            **{name: {table: numbers[kind] for table, numbers in found.items()} for name, kind in kinds.items()},
            "logs": result["logs"],
        }
    if arguments.logs is not None:
        result["logs"] = {**made, "starts": arguments.log_starts, "tables": _logs(arguments, arguments.logs)}
    for table, rows in result["tables"].items():
        for row, numbers in rows.items():
            line = ", ".join(f"{name} {number['mean']:.4g}" for name, number in numbers.items())
            print(f"{table:15} {row:16} {line}")
    return arguments.publish("relocalisation", result, relocalisation_page.page(result))


def measured(arguments: Arguments, name: str) -> dict[str, Any]:
    """All rows of a table: of starts in mapped parts, of other starts, and the errors of the maps themselves."""
    world, aliased = WORLDS[name.removesuffix("_aliased")], name.endswith("_aliased")
    stores = kidnapped_drives(world, arguments.split, aliased, arguments.mazes, arguments.weights, arguments.runs)
    networks, weights = Networks.load(world, arguments.weights), folder_digest(arguments.weights / world.name)
    folder = arguments.runs / world.name / "relocalisation" / f"{arguments.split}_{'aliased_' * aliased}results"
    count = arguments.aliased_starts if aliased else arguments.starts
    drives = [
        Drive(f"maze_{number}", f"{name} {arguments.split} {number}", partial(_Maze, stores, number))
        for number in range(arguments.mazes)
    ]
    map_row = Row(partial(_map, world=world, weights=arguments.weights), weights, _MAP_CODE)
    maps = measure([(drive, {_MAP: map_row}) for drive in drives], folder, f"{name} maps")

    def with_map(drive: Drive) -> dict[str, Row]:
        poses = maps[drive.name][_MAP].drawn["poses"]
        identity = f"{weights} {count} {hashlib.sha256(poses.tobytes()).hexdigest()}"
        return {
            row: Row(partial(_starts, row=row, networks=networks, poses=poses, count=count), identity, _ROW_CODE)
            for row in arguments.rows
        }

    found = measure([(drive, with_map(drive)) for drive in drives], folder, name)
    return {
        **{kind: {row: _summary(column(found, row), kind) for row in arguments.rows} for kind in _KINDS},
        "maps": {**intervals(means_over_samples(column(maps, _MAP))), "starts": _count(len(maps))},
    }


_KINDS = ("mapped", "unmapped")
_MAP = "map"
_MAP_CODE = (online_trajectory, online_estimate)
_ROW_CODE = (relocalisation_rows, kidnapped, localisation, place_matcher, pair_measurement)


@dataclass(frozen=True)
class _Maze:
    stores: dict[str, Features]
    number: int

    def drive(self, name: str) -> Features:
        return {key: np.array(array[self.number]) for key, array in self.stores[name].items()}


def _map(maze: _Maze, world: World, weights: Path) -> Measured:
    """The errors of the map as the online system leaves it; drawn are its corrected poses ``(frames, 3)``."""
    drive = maze.drive("map")
    trajectory = run_online(OnlineTrajectory.load(weights / world.name, world=world.name), drive)
    truth = seen_from_first(drive["poses"])
    off = {"": off_by(trajectory.poses_xyyaw, truth), "online_": off_by(trajectory.online_xyyaw, truth)}
    numbers = {
        "position_rmse_m": rms(np.linalg.norm(off[""][:, :2], axis=1)),
        **{f"{name}heading_rmse_deg": float(np.degrees(rms(found[:, 2]))) for name, found in off.items()},
    }
    return Measured.of(numbers, poses=trajectory.poses_xyyaw)


def _starts(maze: _Maze, row: RowName, networks: Networks, poses: np.ndarray, count: int) -> Measured:
    """Numbers of every start of a maze, ``KIND:NUMBER`` ``(starts,)``."""
    mapped, second = maze.drive("map"), maze.drive("second")
    codes = np.concatenate((mapped["origin_code"], mapped["codes"])).astype(np.float32)
    known = KnownMap(poses, mapped["poses"], codes, networks.pair_head.config.offset_scale_m)
    errors, claims = MapErrors(known, second["poses"]), row_of(row, networks, known, second)
    result: dict[str, np.ndarray] = {}
    for kind, some in zip(_KINDS, starts(errors, len(second["poses"]), count), strict=True):
        described = f"{row}, maze {maze.number}"
        found = [scored(errors, start, claims(start)) for start in tqdm(some, desc=described, unit="start")]
        result |= {f"{kind}:{name}": np.array([one[name] for one in found]) for name in NUMBERS}
    return Measured(result)


def _logs(arguments: Arguments, folder: Path) -> dict[str, Any]:
    """Numbers of each log in the folder."""
    weights, count = arguments.weights / "scan", arguments.log_starts
    row = Row(partial(_log, weights=weights, count=count), f"{count} {folder_digest(weights)}", _LOG_CODE)
    plan = [
        (Drive(name, log_identity(path), partial(read_drive, path), (lidar_logs,)), {"ours": row})
        for name, path in logs_below(folder).items()
    ]
    found = measure(plan, arguments.runs / "scan" / "relocalisation", "logs")
    return {name: summary_of(starts_of(rows["ours"].drawn)) for name, rows in found.items()}


_LOG_CODE = (kidnapped_logs, scan_trajectory, mixture_lidar, localisation, scan_matcher)


def _log(drive: LidarDrive, weights: Path, count: int) -> Measured:
    return Measured(drawn=as_arrays(list(tqdm(log_starts(drive, weights, count), drive.name, count, unit="start"))))


def _summary(mazes: list[Measured], kind: str) -> Numbers:
    """Means over the mazes' means, with intervals by resampling mazes; a number that no two mazes have is left out."""
    result: Numbers = {}
    for name in NUMBERS:
        columns = [maze.errors[f"{kind}:{name}"] for maze in mazes]
        means = np.array([np.nanmean(values) for values in columns if np.isfinite(values).any()])
        if len(means) >= 2:
            result[{"frames": "frames_to_success"}.get(name, name)] = interval_of(means)
    return result | {"starts": _count(sum(len(maze.errors[f"{kind}:{NUMBERS[0]}"]) for maze in mazes))}


def _count(starts: int) -> dict[str, Any]:
    return {"mean": float(starts), "ci95": [float(starts)] * 2}


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
