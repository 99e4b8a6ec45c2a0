"""Make the tables and figures of a world's results, by one command from nothing.

    python -m training.results --world maze2d
    python -m training.results --world maze3d
    python -m training.results --world scan      # of the lidar; each of TABLES has its own --help

Missing networks, features, settings of the pose graph and trainings of the optimizers are made first. Every row is
measured in mazes that nothing was trained or chosen on. The command writes ``training/results/WORLD.json``,
``docs/results_WORLD.md`` and ``docs/images/results_WORLD_*.png``. Run it again to continue after a stop.
"""

import argparse
import json
import sys
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Literal

import numpy as np

from ngo_estimator.loops import overlaps, pair_measurement
from ngo_estimator.ngo import neural_graph_optimizer
from ngo_estimator.trajectory import errors
from training.common import records
from training.common.command_line import check_at_least, run_command
from training.data.feature_store import open_store
from training.data.worlds import world_named
from training.prerequisites import Scripts, Wanted, prepare
from training.report import figures, results_page, tables
from training.report.folders import Folders
from training.report.training_records import trainings_json
from training.scoring import prefix_errors as prefix_errors_module
from training.scoring import row_estimators
from training.scoring.network_odometry import open_odometry
from training.scoring.prefix_errors import prefix_errors
from training.scoring.row_estimators import Arrays, Estimator, Prepared, estimators
from training.scoring.table import Drive, Measured, Row, measure
from training.scoring.table_rows import ROWS, Sources, rows_of


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the results."""

    world: Literal["maze2d", "maze3d"]  # World to measure in.
    split: Literal["validation", "test"] = "test"
    """Mazes to measure in. Designs are chosen on validation; the test split is for the final tables alone."""
    trajectories: int = 0  # Trajectories of each table, each in a maze of its own; 0 for the world's number.
    seeds: int = 3  # Trainings of each optimizer, with the seeds 0, 1, ...
    prefixes: tuple[int, ...] = ()
    """Numbers of steps after which errors are given, as if the robot had stopped there; none: the world's."""

    def __post_init__(self) -> None:
        check_at_least(self, trajectories=2 if self.trajectories else 0, seeds=1)
        if min(self.prefixes, default=1) < 1:
            raise ValueError(f"prefixes are {self.prefixes}; expected numbers of steps, each at least 1")


TABLES = {
    **{
        name: f"results_{name}" for name in ("camera", "doom", "explore", "graphs", "lifelong", "map", "scan", "stress")
    },
    **{name: name for name in ("faults", "relocalisation")},
}
"""The modules of tables that are not of a world of mazes."""

_CODE = (row_estimators, prefix_errors_module, neural_graph_optimizer, overlaps, pair_measurement, errors)


def main(arguments: Arguments, scripts: Scripts | None = None) -> dict[str, Any]:
    """Make what is missing, measure, write everything, and return the JSON's content."""
    world, record = world_named(arguments.world), records.record("results", arguments)
    trajectories, prefixes = arguments.trajectories or world.table_trajectories, arguments.prefixes or world.prefixes
    arguments = replace(arguments, trajectories=trajectories, prefixes=prefixes)
    sources = Sources(world, arguments.weights, arguments.runs, arguments.out)
    prepare(sources, Wanted(arguments.split, arguments.trajectories, arguments.seeds), scripts or Scripts())
    stores = {table: table_data(arguments, sources, table).arrays for table in world.tables}
    evaluations = {table: evaluate_rows(arguments, sources, table) for table in world.tables}
    result = {**record, **summary(arguments, sources, stores, evaluations)}
    result.pop("arguments")
    images = figures.draw_all(arguments.images, sources, arguments.split, stores, evaluations, result)
    print(f"{world.name}: {arguments.out / f'{world.name}.json'}, {arguments.docs / f'results_{world.name}.md'}")
    return arguments.publish(world.name, result, results_page.page(result, images, world))


@dataclass(frozen=True)
class TableData:
    """The features of a table's trajectories, and what identifies them."""

    arrays: Arrays
    identity: str


def table_data(arguments: Arguments, sources: Sources, table: str, row: str = "local") -> TableData:
    """The features that a row gets of a table; raises ``ValueError`` for too few or too short trajectories."""
    kind = ROWS[row]
    own = kind.own_networks or kind.odometry is not None
    sources = sources.of_row(row, 0) if own else sources
    folder = sources.store_folder(arguments.split, table)
    arrays = open_store(folder) if kind.odometry is None else open_odometry(folder)
    count, steps = arrays["relative"].shape[:2]
    if count < arguments.trajectories:
        raise ValueError(
            f"{folder} holds {count} trajectories; expected {arguments.trajectories} or more: remove it to make it anew"
        )
    if max(arguments.prefixes) > steps:
        raise ValueError(f"prefixes are {arguments.prefixes}; expected at most {steps}, the steps of a trajectory")
    identity = f"{folder.name} {(folder / 'networks.json').read_text()}"
    return TableData({name: array[: arguments.trajectories] for name, array in arrays.items()}, identity)


def evaluate_rows(arguments: Arguments, sources: Sources, table: str) -> dict[str, list[Measured]]:
    """What every row gives on a table's trajectories, one measurement for each training seed."""
    shared, prepared = table_data(arguments, sources, table), Prepared()
    rows: dict[str, Row] = {}
    for row in rows_of(sources.world):
        data = table_data(arguments, sources, table, row)
        if not np.array_equal(data.arrays["truth"], shared.arrays["truth"]):
            raise ValueError(f"the features of {row} are of other trajectories than those of the table {table}")
        for seed, estimator in enumerate(estimators(row, arguments.seeds, sources, prepared)):
            rows[f"{row}-seed{seed}"] = _row(sources, estimator, data, arguments.prefixes)
    found = _measured(arguments, sources, table, rows)
    return {
        row: [measured for name, measured in found.items() if name.rpartition("-seed")[0] == row]
        for row in rows_of(sources.world)
    }


def _row(sources: Sources, estimator: Estimator, data: TableData, prefixes: tuple[int, ...]) -> Row:
    identity = json.dumps([estimator.identity, data.identity, sorted(prefixes)])
    return Row(lambda _: prefix_errors(estimator, data.arrays, prefixes, sources.world), identity, _CODE)


def _measured(arguments: Arguments, sources: Sources, table: str, rows: dict[str, Row]) -> dict[str, Measured]:
    """The rows on all trajectories of a table, which are optimised together and are one drive."""
    drive = Drive(table, f"{arguments.split} {table} {arguments.trajectories}", lambda: None)
    folder = arguments.runs / arguments.world / "results" / arguments.split
    return measure([(drive, rows)], folder, f"{sources.world.name} {table}")[table]


def summary(
    arguments: Arguments,
    sources: Sources,
    stores: dict[str, Arrays],
    evaluations: dict[str, dict[str, list[Measured]]],
) -> dict[str, Any]:
    """The content of the JSON."""
    world, prefixes = sources.world, sorted(arguments.prefixes)
    steps = next(iter(stores.values()))["relative"].shape[1]
    return {
        "split": arguments.split,
        "trajectories": arguments.trajectories,
        "steps": steps,
        "seeds": list(range(arguments.seeds)),
        "tables": {name: tables.table_json(table, prefixes, steps, world) for name, table in evaluations.items()},
        "paired": {name: tables.paired_json(table, steps, world) for name, table in evaluations.items()},
        "path_m": {
            name: tables.path_json(arrays["truth"], sorted({*prefixes, steps})) for name, arrays in stores.items()
        },
        "trainings": trainings_json(sources, arguments.seeds),
    }


def command_line(arguments: list[str]) -> None:
    """Make the table that ``--world`` names, with the other flags."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--world")
    known, flags = parser.parse_known_args(arguments)
    names = f"maze2d, maze3d, {', '.join(TABLES)}"
    if known.world in TABLES:
        table = import_module(f"training.{TABLES[known.world]}")
        run_command(table.main, table.Arguments, table.__doc__, flags)
    elif known.world in (None, "maze2d", "maze3d"):
        run_command(main, Arguments, f"{__doc__}\nWorlds are {names}.", arguments)
    else:
        sys.exit(f"there is no world {known.world!r}; expected one of {names}")


if __name__ == "__main__":
    command_line(sys.argv[1:])
