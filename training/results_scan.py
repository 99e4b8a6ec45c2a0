"""The tables and figures of the lidar, by one command.

    python -m training.results --world scan --logs FOLDER

Every row is measured on the logs in a folder, where one is given, on simulated buildings and mazes that nothing was
trained or chosen on, and beside other programs. The command writes ``training/results/scan.json``,
``docs/results_scan.md`` and ``docs/images/results_scan_*.png``. Run it again to continue after a stop.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ngo_recordings import mounting, recording, scan_stream, topics
from ngo_sim import building2d, episodes, maze2d
from training.common import records
from training.common.command_line import check_among, check_at_least, run_command
from training.data import building_drives, simulated_drives
from training.data.building_drives import BUILDING_TEST_SEEDS, building_drive
from training.data.simulated_drives import maze_drive
from training.data.worlds import WORLDS
from training.recordings import lidar_logs
from training.recordings.lidar_logs import log_drive, log_identity, logs_below
from training.report import lidar_figures, lidar_page
from training.report.folders import Folders
from training.scoring.lidar_rows import ROWS, Row
from training.scoring.lidar_scores import scored_rows, with_runs
from training.scoring.statistics import compare, mean_interval
from training.scoring.table import (
    Drive,
    Measured,
    Numbers,
    Table,
    column,
    interval_of,
    intervals,
    means_over_samples,
    measure,
    pairs,
)

_ALIASED_FIRST = 500  # of the test seeds: aliased buildings are others than those of the table without aliasing
_BUILDINGS = (building2d, building_drives)
_MAZES = (maze2d, episodes, simulated_drives)
_READ = (mounting, recording, scan_stream, topics, lidar_logs)
_MOST_SCANS = 20_000  # of a building: some robots stand for hours
_PAIRED = ("ate_m", "within_three_deviations", "negative_log_likelihood")
_SLIPS_PER_KM = 300.0  # of the table of slip; the buildings have up to 60
_ABLATED = ("buildings", "aliased")
_WITH_WHEELS = ("logs", "buildings", "aliased", "slip")
_FED = "percent_wrong"
_SLIP_ROWS = ("wheels", "ours")
_SETTINGS = ("buildings", "first_building", "ablation", "length_m", "mazes", "frames")
_PUBLISHED: dict[str, dict[str, dict[str, float]]] = {
    "aces": {"cartographer_published": {"translation_m": 0.0375, "rotation_deg": 0.373}},
    "mit-csail": {"cartographer_published": {"translation_m": 0.0319, "rotation_deg": 0.369}},
}
"""By log and row, not run here: from Hess et al., "Real-time loop closure in 2D LIDAR SLAM" (ICRA 2016)."""


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the lidar's results."""

    logs: Path | None = None
    """Folder of real logs (.bag, .log, .clf, gzipped or not), with relations as NAME.relations; none: left out."""
    buildings: int = 20  # Simulated buildings of each of the two tables.
    first_building: int = 0
    """Number of the first one among the test seeds: others than those of the tables that are published."""
    length_m: float = 500.0  # Way that the robot drives in a building.
    ablation: int = 5  # How many of these get the rows with wrong loops; and how many buildings have slipping wheels.
    mazes: int = 8  # Mazes.
    frames: int = 2000  # Scans in a maze.
    rows: tuple[str, ...] = ()  # Rows to measure, by name; none: all. Tables that are measured hold these alone.
    tables: tuple[Literal["logs", "buildings", "aliased", "slip", "maze2d"], ...] = ()
    """Tables to measure; none: all. The others hold what earlier runs measured, or what is published."""
    known: bool = False
    """Measure nothing: the tables hold what earlier runs of this command measured, and say of how many drives."""
    weights: Path = records.WEIGHTS / "scan"  # Folder with lidar.json, the settings of our estimators.

    def __post_init__(self) -> None:
        check_among(self, rows=ROWS)
        check_at_least(self, buildings=2, ablation=2, mazes=2, frames=2, length_m=1)
        last = len(BUILDING_TEST_SEEDS) - _ALIASED_FIRST - max(self.buildings, self.ablation)
        if not 0 <= self.first_building <= last:
            raise ValueError(
                f"first_building is {self.first_building}; expected one of the {len(BUILDING_TEST_SEEDS)} test seeds "
                f"that {_ALIASED_FIRST} and as many as are measured follow"
            )


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    rows, skipped = _rows(arguments.rows)
    slip_rows = {name: row for name, row in rows.items() if name in _SLIP_ROWS}
    tables = {
        name: _measured(arguments, name, drives, slip_rows if name == "slip" else rows)
        for name, drives in _plans(arguments, skipped).items()
    }
    logs = tables.pop("logs", {})
    result: dict[str, Any] = {
        **arguments.made("scan"),
        "settings": {name: getattr(arguments, name) for name in _SETTINGS},
        "logs": {name: {**_log_numbers(scored), **_published(name)} for name, scored in logs.items() if scored},
        "tables": {name: _table_numbers(table) for name, table in tables.items()},
        "paired": {name: _paired(table) for name, table in {"logs": logs, **tables}.items()},
        "skipped": skipped,
        "failed": _failures({"logs": logs, **tables}),
    }
    _keep_published(result, arguments.published("scan"))
    images = lidar_figures.draw(arguments.images, logs, tables, result["earlier"])
    for text in skipped:
        print(f"skipped  {text}")
    return arguments.publish("scan", result, lidar_page.page(result, images))


def _keep_published(result: dict[str, Any], published: Mapping[str, Any]) -> None:
    """Take over what is published and not measured anew, with its failures: the logs, and rows of tables.

    ``earlier`` of the result names the revision and the settings of each table with such rows, and under ``measured``
    the revision of each of its rows that is of a later one.
    """
    result["earlier"], anew = {}, {name: list(result["tables"][name]) for name in result["tables"]}
    for name in ("logs", *result["tables"]):
        new, old = (result, published) if name == "logs" else (result["tables"], published.get("tables", {}))
        measured, known = list(new[name]), old.get(name, {}) if name == "logs" else _known(old.get(name, {}))
        if any(row.endswith(_FED) for row in measured):  # these are compared with each other
            known = {row: cell for row, cell in known.items() if not row.endswith(_FED)}
        if known.keys() - measured and not (name == "logs" and measured):
            new[name] = known if name == "logs" else _known({**known, **new[name]})
            result["paired"][name] = {**_known(published["paired"].get(name, {})), **result["paired"][name]}
            of = {"revision": published["revision"], "settings": published["settings"]}
            before = published.get("earlier", {}).get(name, {**of, "measured": {}})
            later = {**before["measured"], **dict.fromkeys(measured, result["revision"])}
            later = {row: revision for row, revision in later.items() if row in new[name]}
            result["earlier"][name] = {**before, "measured": later}
    for line in published.get("failed", ()):
        table, _, row = line.partition(":")[0].split(", ")
        if table in result["earlier"] and row not in anew.get(table, ()):
            result["failed"].append(line)


def _known(rows: Mapping[str, Any]) -> dict[str, Any]:
    return {row: rows[row] for row in ROWS if row in rows}


def _rows(names: Sequence[str]) -> tuple[dict[str, Row], list[str]]:
    """The rows to measure, and in words those that this machine lacks something for."""
    asked = {name: row for name, row in ROWS.items() if not names or name in names}
    lacking = {name: row.missing() for name, row in asked.items()}
    return (
        {name: row for name, row in asked.items() if not lacking[name]},
        [f"{name}: {why}" for name, why in lacking.items() if why],
    )


def _plans(arguments: Arguments, skipped: list[str]) -> dict[str, Sequence[Drive]]:
    """The drives of each table; what is not there is added to what is skipped."""
    seeds = BUILDING_TEST_SEEDS[arguments.first_building :]
    aliased = seeds[_ALIASED_FIRST:]
    mazes = list(WORLDS["maze2d"].table_seeds("perfect", "validation")[: arguments.mazes])
    plans: dict[str, Sequence[Drive]] = {
        "buildings": [_building(arguments, "buildings", seed) for seed in seeds[: arguments.buildings]],
        "aliased": [_building(arguments, "aliased", seed) for seed in aliased[: arguments.buildings]],
        "slip": [_building(arguments, "slip", seed) for seed in seeds[: arguments.ablation]],
        "maze2d": [
            Drive(
                f"maze2d_{seed}",
                f"maze2d {seed}, size by {mazes[0]}, {arguments.frames} frames",
                partial(maze_drive, seed, arguments.frames, mazes[0]),
                _MAZES,
            )
            for seed in mazes
        ],
    }
    logs = {} if arguments.logs is None else logs_below(arguments.logs)
    if not logs:
        skipped.append("logs: no folder is given (--logs)" if arguments.logs is None else "logs: the folder has none")
        return plans
    of_logs = [Drive(name, log_identity(path), partial(log_drive, path), _READ) for name, path in logs.items()]
    return {"logs": of_logs, **plans}


def _building(arguments: Arguments, name: str, seed: int) -> Drive:
    slips = _SLIPS_PER_KM if name == "slip" else None
    named = "" if slips is None else f", {slips:g} slips a km"
    identity = f"building {seed} {name} {arguments.length_m:g} m, {_MOST_SCANS} scans{named}"
    make = partial(building_drive, seed, arguments.length_m, name == "aliased", _MOST_SCANS, slips)
    return Drive(f"{name}_{seed}", identity, make, _BUILDINGS)


def _measured(arguments: Arguments, name: str, drives: Sequence[Drive], rows: Mapping[str, Row]) -> Table:
    """A table; rows of the ablation have its first drives alone, those that need wheels no mazes."""
    folder = arguments.runs / "scan" / "results" / name
    ablation = len(drives) if name == "logs" else arguments.ablation if name in _ABLATED else 0
    scored = scored_rows(rows, arguments.weights)

    def is_asked(index: int, row: Row) -> bool:
        left_out = row.needs_wheels and name not in _WITH_WHEELS
        return (index < ablation or not row.ablation) and not left_out

    plan = [
        (with_runs(drive, arguments.weights), {key: scored[key] for key, row in rows.items() if is_asked(index, row)})
        for index, drive in enumerate(drives)
    ]
    asked = not arguments.tables or name in arguments.tables
    return measure(plan, folder, name, known_only=arguments.known or not asked)


def _log_numbers(scored: Mapping[str, Measured]) -> dict[str, Numbers]:
    """Of one log: means over its relations, the interval by resampling them; one number of a whole log has none."""
    return {row: intervals(one.errors) for row, one in scored.items() if not one.failed}


def _published(log: str) -> dict[str, Numbers]:
    return {
        row: {key: {"mean": value, "ci95": None} for key, value in numbers.items()}
        for row, numbers in _PUBLISHED.get(log, {}).items()
    }


def _table_numbers(found: Table) -> dict[str, Numbers]:
    """Of several drives: means over them, the interval by resampling them, and how many these are."""
    rows = dict.fromkeys(row for measured in found.values() for row, one in measured.items() if one.errors)
    return {
        row: {
            key: {**interval_of(values), "drives": len(values)}
            for key, values in means_over_samples(column(found, row)).items()
        }
        for row in rows
    }


def _paired(found: Table) -> dict[str, Any]:
    """By row: how much larger its numbers are than those of our row on the same drives, in a table of two or more."""
    result: dict[str, Any] = {}
    for row in dict.fromkeys(row for rows in found.values() for row in rows if row != _paired_with(row)):
        both = {key: pairs(found, row, _paired_with(row), key) for key in _PAIRED}
        if any(map(len, both.values())):
            compared = {key: _compared(key, numbers) for key, numbers in both.items() if len(numbers) > 1}
            result[row] = {"with": _paired_with(row), **compared}
    return result


def _compared(key: str, both: np.ndarray) -> dict[str, Any]:
    """A row's numbers against another's ``(drives, 2)``; likelihoods, which may be negative, have no ratio."""
    values, others = both.T
    if key == "negative_log_likelihood":
        return {"difference": mean_interval(values - others).as_json()}
    return compare(values, others).as_json()


def _paired_with(row: str) -> str:
    """Our row that another one is compared with: a peer's with as many wrong loops, ours with none."""
    if row.startswith("ours_") and row.endswith(_FED):
        return "ours_0_percent_wrong"
    if row.endswith(_FED):
        return "_".join(("ours", *row.split("_")[-3:]))
    return "ours"


def _failures(tables: Mapping[str, Table]) -> list[str]:
    return [
        f"{table}, {drive}, {row}: {scored.failed}"
        for table, drives in tables.items()
        for drive, rows in drives.items()
        for row, scored in rows.items()
        if scored.failed
    ]


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
