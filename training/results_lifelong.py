"""The tables of maps that last: several robots in one building, each mapped alone and all together.

    python -m training.results --world lifelong
    python -m training.results --world lifelong --buildings 3 --aliased 3 --scans 1500

What is measured is kept in ``runs/``. The command writes ``training/results/lifelong.json`` and
``docs/results_lifelong.md`` with its picture.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from ngo_estimator.frontend.lidar import mixture_lidar
from ngo_estimator.slam import fleet, scan_trajectory
from training.common import records
from training.common.command_line import check_at_least
from training.data import fleet_drives as drives_module
from training.data.building_drives import BUILDING_TEST_SEEDS
from training.data.fleet_drives import fleet_drives
from training.report import lifelong_page
from training.report.folders import Folders
from training.scoring import fleet_rows
from training.scoring.fleet_rows import FleetRuns
from training.scoring.statistics import mean_interval
from training.scoring.table import Drive, Numbers, Row, Table, column, folder_digest, intervals, measure, pairs, samples

_CODE = (fleet, scan_trajectory, mixture_lidar, fleet_rows)
_SEEDS = {"validation": range(12_000, 13_000), "test": BUILDING_TEST_SEEDS[600:]}
_ROWS = ("alone", "together")
_ALIASED_FIRST = 100  # of the seeds: aliased buildings are others


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the tables."""

    world: Literal["lifelong"] = "lifelong"
    """World to measure in."""
    buildings: int = 5
    """Buildings that robots map together."""
    aliased: int = 5
    """Buildings whose rooms look alike, as many rooms are."""
    robots: int = 2
    """Robots in each building."""
    scans: int = 2000
    """Scans of each robot, ten a second."""
    split: Literal["validation", "test"] = "test"
    """Seeds of the buildings. Settings are chosen on validation; test is for the final table alone."""

    def __post_init__(self) -> None:
        check_at_least(self, buildings=2, aliased=2, robots=2, scans=200)
        if self.buildings > _ALIASED_FIRST:
            raise ValueError(f"buildings is {self.buildings}; expected at most {_ALIASED_FIRST}")


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    record = records.record("results", arguments)
    found = {kind: _measured(kind, arguments) for kind in ("buildings", "aliased")}
    names = {"buildings": "", "aliased": "aliased_"}
    result = {
        "command": _command(arguments),
        "revision": record["revision"],
        "settings": {name: getattr(arguments, name) for name in ("split", "buildings", "aliased", "robots", "scans")},
        "tables": {
            "fleet": {f"{names[kind]}{row}": _numbers(table, row) for kind, table in found.items() for row in _ROWS}
        },
        "paired": {f"{names[kind]}together": {"ate_ratio": _ratio(table)} for kind, table in found.items()},
    }
    images = lifelong_page.draw(arguments.images, found)
    return arguments.publish("lifelong", result, lifelong_page.page(result, images))


def _command(arguments: Arguments) -> str:
    chosen = " ".join(f"--{name} {getattr(arguments, name)}" for name in ("buildings", "aliased", "robots", "scans"))
    if arguments.split != "test":
        chosen += f" --split {arguments.split}"
    return f'make results WORLD=lifelong ARGS="{chosen}"'


def _measured(kind: str, arguments: Arguments) -> Table:
    aliased = kind == "aliased"
    seeds = _SEEDS[arguments.split]
    seeds = seeds[_ALIASED_FIRST:][: arguments.aliased] if aliased else seeds[: arguments.buildings]
    weights = arguments.weights / "scan"
    rows = {row: Row(_MEASURES[row], folder_digest(weights), _CODE) for row in _ROWS}
    drives = [
        Drive(
            f"{kind}_{seed}_{arguments.robots}",
            f"{kind} {seed}, {arguments.robots} robots, {arguments.scans} scans",
            partial(_runs, seed, aliased, arguments),
            (drives_module,),
        )
        for seed in seeds
    ]
    return measure([(drive, rows) for drive in drives], arguments.runs / "lifelong", kind)


def _runs(seed: int, aliased: bool, arguments: Arguments) -> FleetRuns:
    return FleetRuns(fleet_drives(seed, arguments.robots, arguments.scans, aliased), arguments.weights / "scan")


_MEASURES = {"alone": FleetRuns.alone, "together": FleetRuns.together}


def _numbers(table: Table, row: str) -> Numbers:
    return intervals(samples(column(table, row)))


def _ratio(table: Table) -> dict[str, Any]:
    """Error of the robots together, as a share of that of each alone, in the mean over buildings."""
    both = pairs(table, "together", "alone", "ate_m")
    return mean_interval(both[:, 0] / both[:, 1]).as_json()
