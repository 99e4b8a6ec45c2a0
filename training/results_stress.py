"""The tables of what real robots do to their data: errors of the lidar's rows after each change.

    python -m training.results --world stress --logs FOLDER
    python -m training.results --world stress --logs FOLDER --logs-named csail --changes people --seeds 0 --rows ours
    python -m training.results --world stress --tables buildings loops joins car --car RECORDING

FOLDER holds logs (.bag, .log, .clf, gzipped or not) with relations as NAME.relations. What is measured is kept in
``runs/``: a run that is restricted adds to the tables, and one that was stopped goes on. Where the code of today has
measured nothing, what is published stays. The command writes ``training/results/stress.json`` and
``docs/results_stress.md``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from training.common import records
from training.common.command_line import check_among, run_command
from training.data.lidar_changes import CHANGES, UNSEEDED
from training.recordings.lidar_logs import logs_below, relations_of
from training.report import stress_page
from training.report.folders import Folders, with_earlier
from training.scoring import stress_tables
from training.scoring.lidar_rows import FRONT_ABLATION, ROWS
from training.scoring.lidar_scores import scored_rows, with_runs
from training.scoring.stress_bars import stress_bars
from training.scoring.stress_cells import CLEAN, StressLog, cell_numbers
from training.scoring.stress_tables import StressTable
from training.scoring.table import Measured, measure

_FIRST_BUILDINGS = {"validation": 12_000, "test": 22_000}
STRESS_ROWS = ("wheels", "ours", "ours_without_wheels", "kiss_icp")
_ROWS = (*STRESS_ROWS, *FRONT_ABLATION)


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the table."""

    tables: tuple[Literal["logs", "buildings", "loops", "joins", "car"], ...] = ("logs",)
    """Tables to measure: changed logs, changed simulated buildings, loops of poor wheels, wrong joins, a car's loop."""
    logs: Path | None = None  # Folder of real logs with relations as NAME.relations, for the table of logs.
    car: Path | None = None  # Recording whose end lies on its own way, for the table of the car.
    logs_named: tuple[str, ...] = ()  # Logs to measure, by a part of their name; none: all.
    changes: tuple[str, ...] = ()  # Changes to measure, by name; none: all.
    seeds: tuple[int, ...] = (0, 1, 2)  # Seeds of the changes.
    rows: tuple[str, ...] = ()  # Rows to measure, by name; none: all but those of the ablation, without_*.
    drives: int = 20  # Simulated drives in each row of the tables of buildings, loops and joins.
    length: float = 1.0  # Factor on the length of simulated drives.
    split: Literal["validation", "test"] = "test"
    """Buildings to drive in. Designs are chosen on validation; test is for the final tables alone."""

    weights: Path = records.WEIGHTS / "scan"  # Folder with lidar.json, the settings of our estimators.

    def __post_init__(self) -> None:
        check_among(self, changes=CHANGES, rows=_ROWS)
        if not self.seeds or min(self.seeds) < 0:
            raise ValueError(f"seeds are {self.seeds}; expected one or more, none negative")
        if not 1 <= self.drives <= 1000 or not 0.0 < self.length <= 10.0:
            raise ValueError(f"drives, length are {self.drives}, {self.length}; expected 1 to 1000, and up to 10")
        for table, path in (("logs", self.logs), ("car", self.car)):
            if table in self.tables and path is None:
                raise ValueError(f"the table of {table} needs --{table}, which is not given")


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, print each number, write everything, and return the JSON's content."""
    record = records.record("results", arguments)
    rows = [name for name in _ROWS if name not in ROWS or not ROWS[name].missing()]
    asked = [name for name in rows if name in (arguments.rows or STRESS_ROWS)]
    logs = {} if arguments.logs is None else _logs(arguments, rows, asked)
    tables = {name: _simulated(arguments, name, table, asked) for name, table in _tables(arguments).items()}
    if earlier := arguments.published("stress"):
        logs = tables_with_earlier(logs, earlier["logs"], earlier["revision"])
        if earlier["settings"] == {name: getattr(arguments, name) for name in earlier["settings"]}:
            tables = tables_with_earlier(tables, earlier["tables"], earlier["revision"])
    result = {
        "command": 'make results WORLD=stress ARGS="--logs FOLDER"',
        "revision": record["revision"],
        "settings": {name: getattr(arguments, name) for name in ("drives", "length", "split")},
        "logs": logs,
        "tables": tables,
        "bars": [bar.as_json() for bar in stress_bars(logs)],
        "skipped": [f"{name}: {ROWS[name].missing()}" for name in STRESS_ROWS if name not in rows],
    }
    return arguments.publish("stress", result, stress_page.page(result))


def tables_with_earlier(tables: Mapping[str, Any], published: Mapping[str, Any], revision: str) -> dict[str, Any]:
    """``TABLE.CHANGE.ROW`` with what is ``published`` and not measured anew; such a cell names its ``revision``."""
    result: dict[str, Any] = {}
    for table in dict.fromkeys((*tables, *published)):
        old, new = published.get(table, {}), tables.get(table, {})
        result[table] = {
            change: with_earlier(
                new.get(change, {}), {row: old[change][row] for row in old.get(change, {}) if row in _ROWS}, revision
            )
            for change in dict.fromkeys((*CHANGES, *old, *new))
            if change in old or change in new
        }
    return result


def _logs(arguments: Arguments, rows: Sequence[str], asked: Sequence[str]) -> dict[str, Any]:
    assert arguments.logs is not None
    logs = [StressLog(path, arguments.weights, arguments.runs / "stress") for path in _paths(arguments.logs)]
    named = [log for log in logs if any(part in log.name for part in (arguments.logs_named or ("",)))]
    for number, seed in enumerate(arguments.seeds if "logs" in arguments.tables else ()):
        changes = [name for name in arguments.changes or CHANGES if number == 0 or name not in UNSEEDED]
        for log in named:
            _measure(log, changes, seed, asked)
    return {log.name: _table(log, rows, arguments.seeds) for log in logs}


def _tables(arguments: Arguments) -> dict[str, StressTable]:
    size = stress_tables.Size(_FIRST_BUILDINGS[arguments.split], arguments.drives, arguments.length)
    tables = {make.__name__: make(size) for make in (stress_tables.buildings, stress_tables.loops, stress_tables.joins)}
    return tables if arguments.car is None else {**tables, "car": stress_tables.car(arguments.car)}


def _simulated(arguments: Arguments, name: str, table: StressTable, asked: Sequence[str]) -> dict[str, Any]:
    """``GROUP.ROW.{KEY, drives, each}``: means over the drives, how many these are, and the numbers of each."""
    result: dict[str, Any] = {}
    for group, sources in table.groups.items():
        measures = name in arguments.tables and (name != "buildings" or group in (arguments.changes or CHANGES))
        scored: dict[str, list[Measured]] = {}
        for source in sources:
            rows = {row: kind for row, kind in table.rows.items() if row in asked or not measures}
            plan = [(with_runs(source, arguments.weights), scored_rows(rows, arguments.weights))]
            try:
                found = measure(plan, arguments.runs / "stress" / name, known_only=not measures)[source.name]
            except ValueError as error:  # a robot that stands for long has no moment at which it could be carried
                print(f"{name:9s} {source.name:30s} is left out: {error}", flush=True)
                continue
            for row, one in found.items():
                scored.setdefault(row, []).append(one)
                if measures:
                    words = one.failed or "  ".join(f"{k} {v:.3f}" for k, v in _scores(one, table.keys).items())
                    print(f"{name:9s} {source.name:30s} {row:20s} {words}", flush=True)
        if scored:
            result[group] = {row: _means(found, table.keys) for row, found in scored.items()}
    return result


def _scores(scored: Measured, keys: Sequence[str]) -> dict[str, float]:
    """The numbers of one drive that are known."""
    means = {key: float(scored.errors[key].mean()) for key in keys if key in scored.errors}
    return {key: value for key, value in means.items() if np.isfinite(value)}


def _means(scored: Sequence[Measured], keys: Sequence[str]) -> dict[str, Any]:
    each = [_scores(one, keys) for one in scored]
    there = {key: [one[key] for one in each if key in one] for key in keys}
    means = {key: float(np.mean(values)) for key, values in there.items() if values}
    failed = [one.failed for one in scored if one.failed]
    return {**means, "drives": len(scored), "each": there, **({"failed": failed} if failed else {})}


def _paths(folder: Path) -> list[Path]:
    paths = [path for path in logs_below(folder).values() if relations_of(path).is_file()]
    if not paths:
        raise ValueError(f"{folder} has no log with relations as NAME.relations beside it")
    return paths


def _measure(log: StressLog, changes: Sequence[str], seed: int, rows: Sequence[str]) -> None:
    """Every row after every change, and before them without any, which says what would be possible."""
    clean = log.cells(CLEAN, seed, rows)
    for change in changes:
        for name, cell in log.cells(change, seed, rows).items():
            print(f"{log.name:10s} {change:22s} seed {seed}  {name:20s} {_words(log, cell, clean[name])}", flush=True)


def _words(log: StressLog, cell: Measured, clean: Measured) -> str:
    if cell.failed:
        return f"failed: {cell.failed}"
    return "  ".join(f"{key} {value:.3f}" for key, value in cell_numbers(log.relations, cell, clean).items())


def _table(log: StressLog, rows: Sequence[str], seeds: Sequence[int]) -> dict[str, dict[str, Any]]:
    """``CHANGE.ROW.KEY`` of all that is known: means over the seeds, and under ``seeds`` the numbers of each."""
    table: dict[str, dict[str, Any]] = {}
    clean = log.cells(CLEAN, 0, rows, known_only=True)
    for change in CHANGES:
        asked = seeds[:1] if change in UNSEEDED else seeds
        cells = {seed: log.cells(change, seed, rows, known_only=True) for seed in asked}
        for name in rows:
            known = {seed: found[name] for seed, found in cells.items() if name in found}
            if known:
                table.setdefault(change, {})[name] = _numbers(log, known, clean.get(name))
    return table


def _numbers(log: StressLog, cells: Mapping[int, Measured], clean: Measured | None) -> dict[str, Any]:
    if failed := {str(seed): cell.failed for seed, cell in cells.items() if cell.failed}:
        return {"failed": failed}
    each = {str(seed): cell_numbers(log.relations, cell, clean) for seed, cell in cells.items()}
    found = list(each.values())
    keys = [key for key in found[0] if all(key in numbers for numbers in found)]
    return {**{key: float(np.mean([numbers[key] for numbers in found])) for key in keys}, "seeds": each}


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
