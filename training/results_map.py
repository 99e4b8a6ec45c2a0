"""How good the maps are, in unseen mazes beside the true map.

    python -m training.results --world map

Maps are drawn at the poses of the odometry, at corrected and at true poses. Free and occupied cells are compared with
all cells that exact rays from the true poses see. The command writes ``training/results/map.json`` and
``docs/results_map.md``.
"""

import json
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ngo_estimator.checkpoint import load_local, load_optimizer, load_place
from ngo_estimator.geometry import se2
from ngo_estimator.mapping import scan_map
from ngo_estimator.mapping import scan_source as scan_sources
from ngo_estimator.mapping.occupancy_grid import OccupancyMap
from ngo_estimator.mapping.scan_map import ScanMap, ScanMapConfig
from ngo_estimator.mapping.scan_source import ScanSource, scan_source
from ngo_estimator.ngo import whole_trajectory
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from training.common.command_line import check_at_least, run_command
from training.data.batches import seen_from_first
from training.data.episodes import GROUP, simulate
from training.data.features import OPTIMIZER_INPUTS, Networks, features_of
from training.data.worlds import TEST_SEEDS, VALIDATION_SEEDS, World, world_named
from training.report import map_page
from training.report.folders import Folders
from training.scoring import map_errors
from training.scoring.map_errors import intersections, true_map
from training.scoring.online_estimate import steps_of, with_origin
from training.scoring.table import Drive, Measured, Row, column, folder_digest, intervals, measure, samples

_CODE = (map_errors, whole_trajectory, scan_map, scan_sources)
_SPLITS = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}
_ROWS = ("odometry", "corrected", "true")
_CONFIG = ScanMapConfig(most_waiting=10**9)
_THRESHOLDS = _CONFIG.occupancy.free, _CONFIG.occupancy.occupied


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the measurement."""

    worlds: tuple[Literal["maze2d", "maze3d"], ...] = ("maze2d", "maze3d")  # Worlds whose mazes are drawn.
    split: Literal["validation", "test"] = "test"
    """Mazes to measure in. Settings are chosen on validation; the test split is for the final table alone."""
    mazes: int = 20  # Mazes of each world, each with a trajectory of its own.
    frames: int = 500  # Frames of a trajectory.

    def __post_init__(self) -> None:
        check_at_least(self, mazes=2, frames=2)


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    result = {
        **arguments.made("map"),
        "split": arguments.split,
        "mazes": arguments.mazes,
        "frames": arguments.frames,
        "tables": {world: maze_table(arguments, world_named(world)) for world in arguments.worlds},
    }
    print(json.dumps(result["tables"]))
    return arguments.publish("map", result, map_page.page(result))


def drawn(source: ScanSource, steps: list[Any], stamps_ns: np.ndarray, poses: np.ndarray) -> OccupancyMap:
    """The probabilities of the map of all steps at poses ``(frames, 3)``."""
    drawing = ScanMap(_CONFIG)
    for step in steps:
        drawing.take(step, source.scans(step))
    drawing.update(stamps_ns, poses)
    return drawing.cells()


def maze_table(arguments: Arguments, world: World) -> dict[str, Any]:
    """By row: IoU of free and of occupied cells in the mazes of a world, ``{mean, ci95}``."""
    seeds = list(_SPLITS[arguments.split][: arguments.mazes])
    made = Mazes.load(arguments, world)
    # Mazes of a group are simulated together: all are of the size that is drawn for the first.
    groups = [tuple(seeds[first : first + GROUP]) for first in range(0, len(seeds), GROUP)]
    identity = json.dumps([folder_digest(made.folder), repr(_CONFIG)])
    rows = {row: Row(partial(maze_errors, row=row, mazes=made), identity, _CODE) for row in _ROWS}
    drives = [
        Drive(f"mazes_{group[0]}_{len(group)}", f"{group}, {arguments.frames} frames", partial(made.drives, group))
        for group in groups
    ]
    found = measure([(drive, rows) for drive in drives], arguments.runs / world.name / "map", world.name)
    return {row: intervals(samples(column(found, row))) for row in _ROWS}


@dataclass(frozen=True)
class Mazes:
    """What drives through mazes of a world, and the networks and settings that draw their maps."""

    world: World
    folder: Path
    networks: Networks
    optimizer: NeuralGraphOptimizer
    source: ScanSource
    frames: int

    @classmethod
    def load(cls, arguments: Arguments, world: World) -> "Mazes":
        """From the folder of all weights; raises ``ValueError`` where these see no ranges."""
        folder, name = arguments.weights / world.name, world.name
        source = scan_source(folder, name)
        if source is None or world.registration is None:
            raise ValueError(f"the weights of {name} see no ranges; expected ranges behind their place codes")
        networks = Networks(load_local(folder, name)[0], load_place(folder, name)[0])
        optimizer = load_optimizer(folder, name)[0]
        return cls(world, folder, networks, optimizer, source, arguments.frames)

    def drives(self, seeds: tuple[int, ...]) -> list["MazeDrive"]:
        """A drive through each maze of a group."""
        assert self.world.registration is not None
        half_rad = math.radians(self.world.registration.field_of_view_deg) / 2.0
        angles = np.linspace(half_rad, -half_rad, 8 * self.world.registration.rays)
        found = []
        for one in simulate(self.world, list(seeds), self.frames):
            assert one.maze is not None
            true = true_map(one.maze, one.poses_xyyaw, angles, _CONFIG.resolution_m)
            features = features_of(self.world, one, self.folder, self.networks)
            found.append(MazeDrive(one.poses_xyyaw, features, true))
        return found

    def poses(self, drive: "MazeDrive", row: str) -> np.ndarray:
        """The poses ``(frames, 3)`` of a row, seen from the first frame."""
        if row == "true":
            return seen_from_first(drive.poses_xyyaw)
        arrays = [torch.from_numpy(drive.features[name]) for name in OPTIMIZER_INPUTS]
        if row == "odometry":
            return with_origin(se2.r2g(arrays[0].double()).numpy())
        return with_origin(optimize_offline(self.optimizer, self.networks.place.pair_head, *arrays).poses[0].numpy())


@dataclass(frozen=True)
class MazeDrive:
    """True poses in the maze ``(frames, 3)``, what the networks make of the drive, and the true map."""

    poses_xyyaw: np.ndarray
    features: dict[str, np.ndarray]
    true: OccupancyMap


def maze_errors(drives: list[MazeDrive], row: str, mazes: Mazes) -> Measured:
    """IoU of the maps at the poses of a row, one sample a maze."""
    found = []
    for one in drives:
        poses = mazes.poses(one, row).astype(np.float64)
        cells = drawn(mazes.source, list(steps_of(one.features)), np.arange(mazes.frames), poses)
        found.append(intersections(cells.trinary(*_THRESHOLDS), one.true))
    free, occupied = np.array(found).T
    return Measured({"free_iou": free, "occupied_iou": occupied})


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
