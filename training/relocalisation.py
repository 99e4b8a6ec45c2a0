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
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tqdm import tqdm

import ngo_estimator
import training
from ngo_common.files import written_whole
from ngo_estimator.geometry import se2
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.common import records
from training.common.command_line import run_command
from training.common.records import write_at_once
from training.data.kidnapped_drives import Features, kidnapped_drives
from training.data.worlds import WORLDS, World
from training.recordings.lidar_logs import log_identity, logs_below, read_drive
from training.report import relocalisation_page
from training.scoring import kidnapped_logs
from training.scoring.kidnapped import KnownMap, MapErrors, scored, starts
from training.scoring.kidnapped_logs import log_starts, summary_of
from training.scoring.online_estimate import run_online
from training.scoring.relocalisation_rows import ROWS, Networks, RowName, row_of
from training.scoring.statistics import mean_interval

Numbers = dict[str, dict[str, Any]]
"""``{mean, ci95}`` by the name of a number."""

_OURS = ("slam/localisation.py", "slam/evidence.py", "slam/place_matcher.py")
_BASELINES = ("scoring/relocalisation_rows.py",)


@dataclass(frozen=True)
class Arguments:
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
    mazes: int = 10
    """Mazes of each table."""
    starts: int = 50
    """Starts in mapped parts of each maze; up to a fifth as many more are taken in parts without a map."""
    aliased_starts: int = 20
    """The same in each aliased maze."""
    rows: tuple[RowName, ...] = ROWS
    """Rows to measure."""
    logs: Path | None = None
    """Folder of real logs of a lidar (.bag, .log, .clf, gzipped or not); none: they stay as the JSON has them."""
    log_starts: int = 20
    """Starts in each log."""
    weights: Path = records.WEIGHTS
    """Folder with WORLD/*.safetensors."""
    out: Path = records.ROOT / "training" / "results"
    """Folder that gets relocalisation.json."""
    docs: Path = records.ROOT / "docs"
    """Folder that gets results_relocalisation.md."""
    runs: Path = records.ROOT / "runs"
    """Folder of drives, maps and what was measured."""

    def __post_init__(self) -> None:
        if min(self.mazes, self.starts, self.aliased_starts) < 2:
            raise ValueError(
                f"mazes, starts, aliased_starts are {self.mazes}, {self.starts}, {self.aliased_starts}; expected at "
                "least 2 of each"
            )


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write the JSON, and return its content."""
    record, path = records.record("relocalisation", arguments), arguments.out / "relocalisation.json"
    result: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"tables": {}, "logs": {}}
    made = {"command": record["command"], "revision": record["revision"]}
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
        of_logs = {**made, "command": f"{made['command']} --logs FOLDER"}
        result["logs"] = {**of_logs, "starts": arguments.log_starts, "tables": _logs(arguments, arguments.logs)}
    write_at_once(path, json.dumps(result, indent=2) + "\n")
    write_at_once(arguments.docs / "results_relocalisation.md", relocalisation_page.page(result))
    for table, rows in result["tables"].items():
        for row, numbers in rows.items():
            line = ", ".join(f"{name} {number['mean']:.4g}" for name, number in numbers.items())
            print(f"{table:15} {row:16} {line}")
    return result


def measured(arguments: Arguments, table: str) -> dict[str, Any]:
    """All rows of a table: of starts in mapped parts, of other starts, and the errors of the maps themselves."""
    world, aliased = WORLDS[table.removesuffix("_aliased")], table.endswith("_aliased")
    drives = kidnapped_drives(world, arguments.split, aliased, arguments.mazes, arguments.weights, arguments.runs)
    networks = Networks.load(world, arguments.weights)
    folder = arguments.runs / world.name / "relocalisation" / f"{arguments.split}_{'aliased_' * aliased}results"
    folder.mkdir(parents=True, exist_ok=True)
    mazes: list[dict[str, Any]] = []
    for maze in tqdm(range(arguments.mazes), desc=table, unit="maze"):
        mapped, second = ({name: np.array(x[maze]) for name, x in drives[key].items()} for key in ("map", "second"))
        made = _map(world, arguments.weights, mapped, folder / f"map_{maze}.npz", networks.identity)
        count = arguments.aliased_starts if aliased else arguments.starts
        drive = _Maze(networks, made, mapped, second)
        mazes.append({"map": made.numbers, **_rows(arguments.rows, drive, count, folder, maze)})
    return {
        **{kind: {row: _summary([m[row][kind] for m in mazes]) for row in arguments.rows} for kind in _KINDS},
        "maps": _summary([[maze["map"]] for maze in mazes]),
    }


_KINDS = ("mapped", "unmapped")


@dataclass(frozen=True)
class _Map:
    poses: np.ndarray
    numbers: dict[str, float]


def _map(world: World, weights: Path, drive: Features, cache: Path, identity: str) -> _Map:
    """The corrected poses ``(frames, 3)`` of a drive, and their errors, as the online system leaves them."""
    if cache.exists():
        with np.load(cache) as file:
            if str(file["identity"]) == identity:
                return _Map(file["poses"], json.loads(str(file["numbers"])))
    trajectory = run_online(OnlineTrajectory.load(weights / world.name, world=world.name), drive)
    in_maze = torch.from_numpy(drive["poses"])
    truth = se2.between(in_maze[:1], in_maze).numpy()
    numbers = {
        "position_rmse_m": _rms(np.linalg.norm((trajectory.poses_xyyaw - truth)[:, :2], axis=1)),
        "heading_rmse_deg": _heading_rmse(trajectory.poses_xyyaw, truth),
        "online_heading_rmse_deg": _heading_rmse(trajectory.online_xyyaw, truth),
    }
    poses = trajectory.poses_xyyaw.copy()
    with written_whole(cache) as file:
        np.savez(file, identity=np.array(identity), poses=poses, numbers=np.array(json.dumps(numbers)))
    return _Map(poses, numbers)


@dataclass(frozen=True)
class _Maze:
    networks: Networks
    made: _Map
    mapped: Features
    second: Features


def _rows(
    rows: Sequence[str], maze: _Maze, count: int, folder: Path, number: int
) -> dict[str, dict[str, list[dict[str, float]]]]:
    """Numbers of every start of a maze, by row and kind; what was measured before is read."""
    networks, second = maze.networks, maze.second
    codes = np.concatenate((maze.mapped["origin_code"], maze.mapped["codes"])).astype(np.float32)
    known = KnownMap(maze.made.poses, maze.mapped["poses"], codes, networks.pair_head.config.offset_scale_m)
    result: dict[str, dict[str, list[dict[str, float]]]] = {}
    errors: MapErrors | None = None
    for row in rows:
        cache, identity = folder / f"{row}_{number}.json", f"{_code(row)} {networks.identity} {count}"
        stored = json.loads(cache.read_text()) if cache.exists() else {}
        if stored.get("identity") != identity:
            errors = errors or MapErrors(known, second["poses"])
            claims = row_of(row, networks, known, second)
            kinds = zip(_KINDS, starts(errors, len(second["poses"]), count), strict=True)
            described = f"{row}, maze {number}"
            numbers = {
                kind: [scored(errors, start, claims(start)) for start in tqdm(some, desc=described, unit="start")]
                for kind, some in kinds
            }
            stored = {"identity": identity, "numbers": numbers}
            write_at_once(cache, json.dumps(stored))
        result[row] = stored["numbers"]
    return result


def _code(row: str) -> str:
    """A hash of the modules that a row's numbers come from."""
    ours, common = Path(ngo_estimator.__path__[0]), Path(training.__path__[0])
    files = [ours / path for path in _OURS] if row == "ours" else [common / path for path in _BASELINES]
    content = b"".join(path.read_bytes() for path in (*files, common / "scoring" / "kidnapped.py"))
    return hashlib.sha256(content).hexdigest()


def _logs(arguments: Arguments, folder: Path) -> dict[str, Any]:
    """Numbers of each log in the folder."""
    result: dict[str, Any] = {}
    for name, path in tqdm(logs_below(folder).items(), desc="logs", unit="log"):
        cache = arguments.runs / "scan" / "relocalisation" / f"{name}.json"
        identity = f"{log_identity(path)} {_log_code()} {arguments.log_starts}"
        stored = json.loads(cache.read_text()) if cache.exists() else {}
        if stored.get("identity") != identity:
            drive = read_drive(path)
            starts_of_log = log_starts(drive, arguments.weights / "scan", arguments.log_starts)
            found = list(tqdm(starts_of_log, desc=name, total=arguments.log_starts, unit="start"))
            stored = {"identity": identity, "numbers": summary_of(found)}
            cache.parent.mkdir(parents=True, exist_ok=True)
            write_at_once(cache, json.dumps(stored))
        result[name] = stored["numbers"]
    return result


def _log_code() -> str:
    """A hash of the package that numbers of logs come from."""
    files = [*sorted(Path(ngo_estimator.__path__[0]).rglob("*.py")), Path(kidnapped_logs.__file__)]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def _summary(mazes: list[list[dict[str, float]]]) -> Numbers:
    """Means over the mazes' means, with intervals by resampling mazes; a number that no two mazes have is left out."""
    result: Numbers = {}
    for name in dict.fromkeys(name for maze in mazes for start in maze for name in start):
        columns = [np.array([start[name] for start in maze]) for maze in mazes if maze]
        means = np.array([np.nanmean(column) for column in columns if np.isfinite(column).any()])
        if len(means) >= 2:
            result[{"frames": "frames_to_success"}.get(name, name)] = mean_interval(means).as_json()
    return result | {"starts": {"mean": float(sum(map(len, mazes))), "ci95": [float(sum(map(len, mazes)))] * 2}}


def _heading_rmse(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.degrees(_rms((poses[:, 2] - truth[:, 2] + np.pi) % (2.0 * np.pi) - np.pi)))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
