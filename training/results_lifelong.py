"""The tables of maps that last: several robots in one building, and one robot in a building that changes for a year.

    python -m training.results --world lifelong
    python -m training.results --world lifelong --tables fleet join --buildings 3 --aliased 3 --scans 1500
    python -m training.results --world lifelong --tables fleet --robots 4 --buildings 3 --aliased 2
    python -m training.results --world lifelong --tables year --years 1 --drives 20 --year-scans 1000

What is measured is kept in ``runs/``, of a year each drive, so that the command goes on after a stop. It writes
``training/results/lifelong.json`` and ``docs/results_lifelong.md`` with its pictures. A table that is not measured
stays as the JSON has it; more robots than two have tables of their own.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from ngo_estimator.frontend.lidar import mixture_lidar
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.mapping import scan_map
from ngo_estimator.slam import fleet, scan_trajectory, session, session_union
from training.common.command_line import check_at_least
from training.common.source_code import code_digest
from training.data import fleet_drives as drives_module
from training.data import year_drives
from training.data.building_drives import BUILDING_TEST_SEEDS
from training.data.fleet_drives import fleet_drives
from training.report import lifelong_page
from training.report.folders import Folders
from training.scoring import fleet_rows, year_rows
from training.scoring.fleet_rows import FleetRuns
from training.scoring.statistics import mean_interval
from training.scoring.table import Drive, Numbers, Row, Table, column, folder_digest, intervals, measure, pairs, samples
from training.scoring.year_rows import Year, patrol, year_least, year_numbers, year_ratios

_YEAR_CODE = (session, scan_map, scan_trajectory, mixture_lidar, year_rows)
_YEAR_FIRST = 200
_NO_END = 10**9  # key scans, which no year has
_CODE = (fleet, session_union, scan_trajectory, mixture_lidar, fleet_rows)
_SEEDS = {"validation": range(12_000, 13_000), "test": BUILDING_TEST_SEEDS[600:]}
_ROWS = {"fleet": ("alone", "together"), "join": ("alone", "joined")}
_PREFIX = {"buildings": "", "aliased": "aliased_"}
_ALIASED_FIRST = 100  # of the seeds: aliased buildings are others


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the tables."""

    tables: tuple[Literal["fleet", "join", "year"], ...] = ("fleet", "join", "year")
    """Tables to measure."""
    buildings: int = 5
    """Buildings that robots map together."""
    aliased: int = 5
    """Buildings whose rooms look alike, as many rooms are."""
    robots: int = 2
    """Robots in each building."""
    scans: int = 2000
    """Scans of each robot, ten a second."""
    years: int = 3
    """Buildings that a robot patrols for a year."""
    drives: int = 200
    """Drives of a year."""
    year_rows: tuple[Literal["learn", "keep_all"], ...] = ("learn",)
    """Rows of a year; keep_all: no key scan ever leaves the graph."""
    year_scans: int = 2000
    """Scans of each drive."""
    starts: int = 4
    """Starts in each drive at which a robot looks for itself in the map so far."""
    most_scans: int = ScanGraphConfig.most_scans
    """Key scans from which on old ones leave the graph in a year; a shorter year shows with fewer whether it holds."""
    split: Literal["validation", "test"] = "test"
    """Seeds of the buildings. Settings are chosen on validation; test is for the final table alone."""

    def __post_init__(self) -> None:
        check_at_least(self, buildings=2, aliased=2, robots=2, scans=200, years=1, drives=2, year_scans=400, starts=1)
        if self.buildings > _ALIASED_FIRST:
            raise ValueError(f"buildings is {self.buildings}; expected at most {_ALIASED_FIRST}")


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    result, made = arguments.published("lifelong") or {"tables": {}}, arguments.made("lifelong")
    for name in arguments.tables:
        settings = {setting: getattr(arguments, setting) for setting in ("split", *_SETTINGS[name])}
        how = {**made, "settings": settings}
        if name == "year":
            table = _years(arguments)
            for row in arguments.year_rows:
                years, key = column(table, row), "year" if row == "learn" else f"year_{row}"
                result[key] = {**how, "ratios": year_ratios(years), "least": year_least(years)}
                result["tables"][key] = year_numbers(years)
            lifelong_page.draw_year(arguments.images, table)
        else:
            found = {kind: _fleets(kind, name, arguments) for kind in _PREFIX}
            key = name if arguments.robots == 2 else f"{name}_{arguments.robots}"
            result[key] = {**how, "paired": _paired(found, name)}
            result["tables"][key] = _robots(found, name)
            if name == "fleet":
                lifelong_page.draw_fleets(arguments.images, key, found)
    return arguments.publish("lifelong", result, lifelong_page.page(result, arguments.images))


_SETTINGS = {
    "fleet": ("buildings", "aliased", "robots", "scans"),
    "join": ("buildings", "aliased", "robots", "scans"),
    "year": ("years", "drives", "year_rows", "year_scans", "starts", "most_scans"),
}


def _robots(found: dict[str, Table], name: str) -> dict[str, Numbers]:
    return {
        f"{_PREFIX[kind]}{row}": intervals(samples(column(table, row)))
        for kind, table in found.items()
        for row in _ROWS[name]
    }


def _paired(found: dict[str, Table], name: str) -> dict[str, Any]:
    """Error of the robots in one map, as a share of that of each alone, in the mean over buildings."""
    alone, as_one = _ROWS[name]
    both = {kind: pairs(table, as_one, alone, "ate_m") for kind, table in found.items()}
    return {
        f"{_PREFIX[kind]}{as_one}": {"ate_ratio": mean_interval(two[:, 0] / two[:, 1]).as_json()}
        for kind, two in both.items()
    }


def _years(arguments: Arguments) -> Table:
    weights, folder = arguments.weights / "scan", arguments.runs / "lifelong"
    identity = f"{folder_digest(weights)} {code_digest((*_YEAR_CODE, year_drives))}"
    measures = {"learn": patrol, "keep_all": lambda year, identity: patrol(replace(year, most_scans=_NO_END), identity)}
    rows: dict[str, Row] = {
        row: Row(partial(measures[row], identity=identity), folder_digest(weights), _YEAR_CODE)
        for row in arguments.year_rows
    }
    of_each = arguments.drives, arguments.year_scans, arguments.starts, arguments.most_scans
    plan = [
        (
            Drive(
                f"year_{seed}",
                f"building {seed}, {of_each} drives, scans, starts, most scans",
                partial(Year, seed, *of_each, weights, folder / f"year_{seed}"),
                (year_drives,),
            ),
            rows,
        )
        for seed in _SEEDS[arguments.split][_YEAR_FIRST:][: arguments.years]
    ]
    return measure(plan, folder, "year")


def _fleets(kind: str, name: str, arguments: Arguments) -> Table:
    aliased = kind == "aliased"
    seeds = _SEEDS[arguments.split]
    seeds = seeds[_ALIASED_FIRST:][: arguments.aliased] if aliased else seeds[: arguments.buildings]
    weights = arguments.weights / "scan"
    rows = {row: Row(_MEASURES[row], folder_digest(weights), _CODE) for row in _ROWS[name]}
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


_MEASURES = {"alone": FleetRuns.alone, "together": FleetRuns.together, "joined": FleetRuns.joined}
