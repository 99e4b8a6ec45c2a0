"""How good the maps are: in unseen mazes beside the true map, on real logs by how crisp they are.

    python -m training.results_map --logs FOLDER

Maps are drawn at the poses of the odometry, at corrected and at true poses. In mazes, free and occupied cells are
compared with all cells that exact rays from the true poses see. On logs the mean entropy of the known cells and the
occupied cells a metre of the way are given, where a log has reference poses at these also.
The command writes ``training/results/map.json`` and ``docs/results_map.md``.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tqdm import tqdm

from ngo_estimator.checkpoint import load_local, load_optimizer, load_place
from ngo_estimator.frontend.lidar.lidar_odometry import LidarStep
from ngo_estimator.geometry import se2
from ngo_estimator.mapping.occupancy_grid import OccupancyConfig, OccupancyMap
from ngo_estimator.mapping.scan_map import ScanMap, ScanMapConfig
from ngo_estimator.mapping.scan_source import KeyScans, ScanSource, scan_source
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from training.common import records
from training.common.command_line import run_command
from training.common.records import write_at_once
from training.data.episodes import GROUP, simulate
from training.data.features import OPTIMIZER_INPUTS, features_of
from training.data.lidar_drives import ReferencePoses
from training.data.worlds import TEST_SEEDS, VALIDATION_SEEDS, World, world_named
from training.recordings.lidar_logs import logs_below, read_drive
from training.report.results_page import interval, markdown
from training.scoring.lidar_rows import DriveRuns, Pipeline
from training.scoring.map_errors import intersections, mean_entropy_bits, seen_from, true_map
from training.scoring.metrics import path_length_m
from training.scoring.online_estimate import steps_of, with_origin
from training.scoring.statistics import mean_interval

_SPLITS = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}
_ROWS = ("odometry", "corrected", "true")
_DEFAULT = OccupancyConfig()


@dataclass(frozen=True)
class Arguments:
    """Settings of the measurement."""

    worlds: tuple[Literal["maze2d", "maze3d"], ...] = ("maze2d", "maze3d")
    """Worlds whose mazes are drawn."""
    split: Literal["validation", "test"] = "test"
    """Mazes to measure in. Settings are chosen on validation; the test split is for the final table alone."""
    mazes: int = 20
    """Mazes of each world, each with a trajectory of its own."""
    frames: int = 500
    """Frames of a trajectory."""
    logs: Path | None = None
    """Folder of real logs (.bag, .log, .clf, gzipped or not); none: left out."""
    hit: float = _DEFAULT.hit
    """Log odds that a scan adds to a cell in which it ends."""
    passed: float = _DEFAULT.passed
    """Log odds that a scan takes from a cell which it looks through."""
    max_range_m: float = 0.0
    """Longest range that enters a map; 0: that of ngo_map."""
    weights: Path = records.WEIGHTS
    """Folder with the weights of each world."""
    out: Path = records.ROOT / "training" / "results"
    """Folder that gets map.json."""
    docs: Path = records.ROOT / "docs"
    """Folder that gets results_map.md."""

    def __post_init__(self) -> None:
        if self.mazes < 2 or self.frames < 2:
            raise ValueError(f"mazes, frames are {self.mazes}, {self.frames}; expected at least 2 of each")

    @property
    def map_config(self) -> ScanMapConfig:
        """Settings of the maps."""
        return ScanMapConfig(occupancy=OccupancyConfig(hit=self.hit, passed=self.passed), most_waiting=10**9)


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    record = records.record("results_map", arguments)
    skipped: list[str] = []
    result = {
        "command": "python -m training.results_map" + (" --logs FOLDER" if arguments.logs else ""),
        "revision": record["revision"],
        "split": arguments.split,
        "mazes": arguments.mazes,
        "frames": arguments.frames,
        "tables": {world: maze_table(arguments, world_named(world)) for world in arguments.worlds},
        "logs": log_table(arguments, skipped),
        "skipped": skipped,
    }
    write_at_once(arguments.out / "map.json", json.dumps(result, indent=2) + "\n")
    write_at_once(arguments.docs / "results_map.md", page(result))
    print(json.dumps({"tables": result["tables"], "skipped": skipped}))
    return result


def drawn(
    config: ScanMapConfig, source: ScanSource, steps: list[Any], stamps_ns: np.ndarray, poses: np.ndarray
) -> OccupancyMap:
    """The probabilities of the map of all steps at poses ``(frames, 3)``."""
    scan_map = ScanMap(config)
    for step in steps:
        scan_map.take(step, source.scans(step))
    scan_map.update(stamps_ns, poses)
    return scan_map.cells()


def maze_table(arguments: Arguments, world: World) -> dict[str, Any]:
    """By row: IoU of free and of occupied cells in the mazes of a world, ``{mean, ci95}``."""
    folder = arguments.weights / world.name
    networks = load_local(folder, world.name)[0], load_place(folder, world.name)[0]
    optimizer = load_optimizer(folder, world.name)[0]
    source = scan_source(folder, world.name, arguments.max_range_m)
    if source is None or world.registration is None:
        raise ValueError(f"the weights of {world.name} see no ranges; expected ranges behind their place codes")
    half_rad = math.radians(world.registration.field_of_view_deg) / 2.0
    angles = np.linspace(half_rad, -half_rad, 8 * world.registration.rays)
    found: dict[str, list[tuple[float, float]]] = {row: [] for row in _ROWS}
    config, occupancy = arguments.map_config, arguments.map_config.occupancy
    seeds = list(_SPLITS[arguments.split][: arguments.mazes])
    with tqdm(total=len(seeds), desc=world.name, unit="maze") as bar:
        for group in (seeds[i : i + GROUP] for i in range(0, len(seeds), GROUP)):
            for episode in simulate(world, group, arguments.frames):
                features = features_of(world, episode, folder, networks)
                arrays = [torch.from_numpy(features[name]) for name in OPTIMIZER_INPUTS]
                poses = {
                    "odometry": with_origin(se2.r2g(arrays[0].double()).numpy()),
                    "corrected": with_origin(
                        optimize_offline(optimizer, networks[1].pair_head, *arrays).poses[0].numpy()
                    ),
                    "true": seen_from(episode.poses_xyyaw[0], episode.poses_xyyaw),
                }
                assert episode.maze is not None
                true = true_map(episode.maze, episode.poses_xyyaw, angles, config.resolution_m)
                steps, stamps = list(steps_of(features)), np.arange(arguments.frames)
                for row, estimate in poses.items():
                    cells = drawn(config, source, steps, stamps, estimate.astype(np.float64))
                    found[row].append(intersections(cells.trinary(occupancy.free, occupancy.occupied), true))
                bar.update()
    return {
        row: {
            key: mean_interval(np.array(values)[:, k]).as_json() for k, key in enumerate(("free_iou", "occupied_iou"))
        }
        for row, values in found.items()
    }


def log_table(arguments: Arguments, skipped: list[str]) -> dict[str, Any]:
    """By log and row: mean entropy (bit) of the known cells, and occupied cells a metre of the way."""
    logs = {} if arguments.logs is None else logs_below(arguments.logs)
    if not logs:
        skipped.append("logs: no folder is given (--logs), or it has none")
    table: dict[str, Any] = {}
    for name, path in tqdm(logs.items(), desc="logs", unit="log"):
        drive = read_drive(path)
        try:
            run = DriveRuns(drive, arguments.weights / "scan").run(Pipeline())
        except ValueError as error:
            skipped.append(f"{name}: {error}")
            continue
        trajectory = run.trajectory
        poses = {"odometry": trajectory.odometry_xyyaw, "corrected": trajectory.poses_xyyaw}
        steps: list[LidarStep] = list(run.front.steps)
        if isinstance(drive.reference, ReferencePoses):
            known = dict(zip(drive.reference.stamps_ns.tolist(), drive.reference.poses_xyyaw, strict=True))
            if all(stamp in known for stamp in trajectory.stamps_ns.tolist()):
                poses["reference"] = np.array([known[stamp] for stamp in trajectory.stamps_ns.tolist()])
        way_m = path_length_m(trajectory.poses_xyyaw)
        table[name] = {}
        for row, estimate in poses.items():
            cells = drawn(arguments.map_config, KeyScans(arguments.max_range_m), steps, trajectory.stamps_ns, estimate)
            occupied = int((cells.trinary(_DEFAULT.free, _DEFAULT.occupied).values == 100).sum())
            table[name][row] = {"entropy_bits": mean_entropy_bits(cells), "occupied_cells_a_metre": occupied / way_m}
    return table


def page(result: dict[str, Any]) -> str:
    """The page of the results."""
    lines = [
        "# Maps",
        "",
        f"Made by `{result['command']}`. Intervals are of 95 %, by resampling mazes.",
        "",
        "Intersection over union of the map's cells with all cells that exact rays from the true poses see: free",
        f"cells, and cells that a wall's surface crosses. {result['mazes']} mazes a world, of the {result['split']}",
        f"split, {result['frames']} frames each, cells of 0.05 m, all poses seen from the first one.",
        "",
    ]
    header = ["World", "Poses", "Free cells, IoU", "Occupied cells, IoU"]
    rows = [
        [f"`{world}`", row, interval(entry["free_iou"]), interval(entry["occupied_iou"])]
        for world, table in result["tables"].items()
        for row, entry in table.items()
    ]
    lines += [markdown(header, rows), ""]
    if result["logs"]:
        header = ["Log", "Poses", "Mean entropy of known cells, bit", "Occupied cells a metre of the way"]
        rows = [
            [f"`{log}`", row, f"{entry['entropy_bits']:.4f}", f"{entry['occupied_cells_a_metre']:.1f}"]
            for log, table in result["logs"].items()
            for row, entry in table.items()
        ]
        lines += [
            "Real logs of a lidar. Scans that contradict each other raise the entropy, and blur walls into more cells.",
            "`reference`: the poses of the mapper that wrote the log.",
            "",
            markdown(header, rows),
            "",
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
