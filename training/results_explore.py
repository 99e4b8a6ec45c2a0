"""The tables of exploration: how far a robot drives until it has seen 95 % of what it can see, by rule.

    python -m training.results --world explore
    python -m training.results --world explore --worlds mazes --count 20 --rows explore_lite ours
    python -m training.results --world explore --worlds plans --plans FOLDER
    python -m training.results --world explore --worlds good_wheels no_wheels --buildings 2 --rows nearest ours

The robot explores in this process, with the same map, follower and limits in all rows. In mazes, buildings and plans it
knows its true poses. In good_wheels, slipping_wheels, no_wheels and short_range it is in buildings, and its poses and
its map are those of the lidar's estimators. FOLDER holds maps of a map server as NAME.yaml. What is measured is kept in
``runs/``. The command writes ``training/results/explore.json``, ``docs/results_explore.md`` and
``docs/images/results_explore_*.png``. Kinds of places that it does not measure stay there as they were.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Literal

import numpy as np

import ngo_explorer
from ngo_explorer.settings import RULES, DriveConfig, ExplorerConfig
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.maze2d import Maze2DConfig
from training.common import records
from training.common.command_line import check_among, check_at_least
from training.data import explored_worlds
from training.data.building_drives import BUILDING_TEST_SEEDS
from training.data.explored_worlds import RANGE_M, RANGES_M, WHEELS, Building, ExploredWorld, Maze
from training.data.worlds import TEST_SEEDS, VALIDATION_SEEDS
from training.report import explore_page
from training.report.explore_figures import draw_figures
from training.report.folders import Folders
from training.scoring import exploring, known_tour, own_poses
from training.scoring.exploring import ENOUGH, Estimator, Explored, Seen, TruePosesMap, drive_known_tour, explore
from training.scoring.map_errors import intersections
from training.scoring.own_poses import OwnPoses
from training.scoring.statistics import mean_interval
from training.scoring.table import (
    Drive,
    Measured,
    Row,
    Table,
    column,
    folder_digest,
    intervals,
    measure,
    pairs,
    samples,
)

ROWS = (*(rule for rule in RULES if rule != ExplorerConfig.rule), "known_tour", "ours")
BASE = "explore_lite"
_EXPLORER = tuple(
    import_module(f"ngo_explorer.{found.name}") for found in iter_modules(ngo_explorer.__path__) if not found.ispkg
)
_CODE = (*_EXPLORER, exploring, known_tour)
_BUILDING_SEEDS = {"validation": range(12_000, 13_000), "test": BUILDING_TEST_SEEDS}
_MAZE_SEEDS = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}


Kind = Literal["mazes", "buildings", "plans", "good_wheels", "slipping_wheels", "no_wheels", "short_range"]


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the table."""

    worlds: tuple[Kind, ...] = ("mazes", "buildings")
    """Kinds of places: 2D mazes, drawn buildings, floor plans from files, and buildings with poses of its own."""
    plans: Path | None = None
    """Folder of floor plans, for the kind plans."""
    rows: tuple[str, ...] = ROWS
    """Rules to measure; explore_lite is always measured."""
    own_rows: tuple[str, ...] = ("nearest", BASE, "ours")
    """Those of them to measure at poses of its own: each takes longer. Nobody drives the known tour without poses."""
    count: int = 10
    """Mazes."""
    buildings: int = 4
    """Buildings of each kind; of plans all are taken."""
    scale: float = 0.5
    """Factor on the length of the corridors of drawn buildings."""
    most_s: float = 7200.0
    """Simulated time after which an exploration is stopped, s."""
    split: Literal["validation", "test"] = "test"
    """Seeds of the places. Rules are chosen on validation; test is for the final table alone."""

    def __post_init__(self) -> None:
        check_among(self, rows=ROWS, own_rows=ROWS)
        if "known_tour" in self.own_rows:
            raise ValueError("own_rows has known_tour, which needs true poses; expected other rules")
        if "plans" in self.worlds and self.plans is None:
            raise ValueError("the kind plans needs --plans, which is not given")
        check_at_least(self, count=2, buildings=2, most_s=1)


@dataclass(frozen=True)
class Place:
    """A place: what makes it anew for each row, and what can be seen of it."""

    make: Callable[[], ExploredWorld]
    seen: Seen


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    names = [name for name in ROWS if name in (*arguments.rows, BASE)]
    found: dict[str, Table] = {kind: _table(kind, names, arguments) for kind in arguments.worlds}
    settings = {name: getattr(arguments, name) for name in ("split", "scale", "most_s")}
    measured = {**arguments.made("explore"), "settings": settings}
    images = draw_figures(arguments.images, found)
    result: dict[str, dict[str, Any]] = {
        "measured": dict.fromkeys(found, measured),
        "images": {kind: {name: text for name, text in images.items() if f"_{kind}_" in name} for kind in found},
        "places": {kind: len(table) for kind, table in found.items()},
        "poses": {kind: "own" if kind in WHEELS else "true" for kind in found},
        "tables": {
            kind: {row: intervals(samples(column(table, row))) for row in names if column(table, row)}
            for kind, table in found.items()
        },
        "paired": {
            kind: {row: _paired(table, row) for row in names if row != BASE and column(table, row)}
            for kind, table in found.items()
        },
    }
    before = arguments.published("explore")
    result = {part: {**before.get(part, {}), **kinds} for part, kinds in result.items()}
    return arguments.publish("explore", result, explore_page.page(result))


def _table(kind: Kind, names: Sequence[str], arguments: Arguments) -> Table:
    allowed = (*arguments.own_rows, BASE) if kind in WHEELS else ROWS
    chosen = [name for name in names if name in allowed]
    rows = {name: _row(name, kind, arguments) for name in chosen}
    plan = [(drive, rows) for drive in _drives(kind, arguments)]
    return measure(plan, arguments.runs / "explore" / kind, kind)


def _drives(kind: str, arguments: Arguments) -> Iterator[Drive]:
    for name, identity, make in _places(kind, arguments):
        yield Drive(name, identity, partial(_place, make), (explored_worlds, exploring))


def _places(kind: str, arguments: Arguments) -> Iterator[tuple[str, str, Callable[[], ExploredWorld]]]:
    if kind == "mazes":
        for seed in _MAZE_SEEDS[arguments.split][: arguments.count]:
            yield f"maze_{seed}", f"maze {seed}", partial(Maze, seed, Maze2DConfig())
    elif kind != "plans":
        plan = FloorPlanConfig(scale=arguments.scale, people=0)
        wheels, range_m = WHEELS.get(kind), RANGES_M.get(kind, RANGE_M)
        for seed in _BUILDING_SEEDS[arguments.split][: arguments.buildings]:
            make = partial(Building, seed, plan, wheels=wheels, range_m=range_m)
            yield f"building_{seed}_{arguments.scale:g}", f"building {seed} {plan} {wheels} {range_m}", make
    else:
        assert arguments.plans is not None
        for path in sorted(arguments.plans.glob("*.yaml")):
            plan = FloorPlanConfig(plan=str(path), people=0)
            yield f"plan_{path.stem}", f"plan {path.name}", partial(Building, 0, plan)


def _place(make: Callable[[], ExploredWorld]) -> Place:
    return Place(make, Seen(*make().exact_scans()))


def _row(name: str, kind: Kind, arguments: Arguments) -> Row:
    identity = f"{name} {arguments.most_s}"
    if kind not in WHEELS:
        return Row(partial(_measure, name=name, most_s=arguments.most_s), identity, _CODE)
    weights = records.WEIGHTS / "scan"
    make = partial(_measure, name=name, most_s=arguments.most_s, estimator=partial(OwnPoses, weights))
    return Row(make, f"{identity} {folder_digest(weights)}", (*_CODE, own_poses))


def _measure(
    place: Place, name: str, most_s: float, estimator: Callable[[np.ndarray], Estimator] = TruePosesMap
) -> Measured:
    world = place.make()
    rule = name if name in RULES else ExplorerConfig.rule
    # What lies farther away than the lidar sees is not seen from there.
    config = ExplorerConfig(rule=rule, radius_m=world.radius_m, reach_m=min(ExplorerConfig.reach_m, world.range_m))
    if name == "known_tour":
        run = drive_known_tour(world, place.seen, config, DriveConfig(), most_s)
    else:
        run = explore(world, place.seen, config, DriveConfig(), most_s=most_s, estimator=estimator)
    return Measured.of(
        scores(run, place.seen),
        path_m=run.path_m,
        coverage=run.coverage,
        way=run.poses_xyyaw[::5],
        free=np.packbits(place.seen.map.values == 0, axis=1),
        columns=np.array(place.seen.map.values.shape[1]),
        corner=place.seen.map.origin_xy,
    )


def scores(run: Explored, seen: Seen) -> dict[str, float]:
    """The metrics of one exploration; a path that never reached 95 % has no length."""
    found: dict[str, float] = {
        **run.errors,
        "ended_early": float(run.ended and run.coverage[-1] < 0.98),
        "ended": float(run.ended),
        "coverage": float(run.coverage[-1]),
        "in_reach": run.in_reach,
        "in_reach_early": float(run.ended and run.in_reach < 0.98),
        "path_m": float(run.path_m[-1]),
        "time_s": float(run.time_s[-1]),
        "iou": 0.5 * sum(intersections(run.found, seen.map)),
        "iou_true_poses": 0.5 * sum(intersections(run.at_true_poses, seen.map)),
        "collisions": 1e3 * run.collisions / max(float(run.path_m[-1]), 1.0),
        "decision_ms": float(np.percentile(run.decisions_ms, 99)) if len(run.decisions_ms) else 0.0,
    }
    if np.isfinite(run.path_to(ENOUGH)):
        found["path_to_95_m"] = run.path_to(ENOUGH)
    return found


def _paired(table: Table, row: str) -> dict[str, Any]:
    """Geometric mean of the paths to 95 % by those of explore_lite's rule, on the places where both got there."""
    both = pairs(table, row, BASE, "path_to_95_m")
    if len(both) < 2:
        return {"path_to_95_ratio": {"mean": None, "ci95": None}, "places": len(both)}
    ratio = mean_interval(np.log(both[:, 0] / both[:, 1]))
    bounds = {"mean": float(np.exp(ratio.mean)), "ci95": [float(np.exp(ratio.low)), float(np.exp(ratio.high))]}
    return {"path_to_95_ratio": bounds, "places": len(both)}
