"""Measure the scan model with lidars of many qualities, on validation mazes.

    python -m training.evaluate_scan

Each row changes one or two properties of the drawn lidars. Noise of 5 cm and dropouts of 20 % lie outside of the
training data. The row `maze2d` has the noise-free lidar of that simulator, in its own mazes. The last line is the table
as one JSON object.
"""

import dataclasses
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from ngo_estimator.checkpoint import load_local, load_optimizer, load_place
from ngo_estimator.data.images import ImageFormat, scan_image
from ngo_estimator.geometry import se2
from ngo_estimator.optimizer.whole_trajectory import optimize_offline
from ngo_sim.episodes import Episode, record_episode
from ngo_sim.maze2d import Maze2DConfig
from training.common import runs
from training.data.episodes import simulate
from training.data.features import OPTIMIZER_INPUTS, features_of
from training.data.scans import ScannedMaze
from training.data.worlds import WORLDS
from training.scoring.metrics import TrajectoryError, path_length_m, trajectory_error

CONDITIONS: dict[str, dict[str, Any]] = {
    "as drawn in training": {},
    "noise 0 cm": {"noise_m": 0.0},
    "noise 1 cm": {"noise_m": 0.01},
    "noise 3 cm": {"noise_m": 0.03},
    "noise 5 cm": {"noise_m": 0.05},
    "dropouts 0 %": {"dropout": 0.0},
    "dropouts 5 %": {"dropout": 0.05},
    "dropouts 20 %": {"dropout": 0.2},
    "noise 5 cm, dropouts 20 %": {"noise_m": 0.05, "dropout": 0.2},
    "field of view 180 deg": {"field_of_view_deg": 180.0},
    "field of view 360 deg": {"field_of_view_deg": 360.0},
    "range 4 m": {"range_max_m": 4.0},
}
OWN_SCANNER = "maze2d"


@dataclass(frozen=True)
class Arguments:
    """Settings of the evaluation."""

    trajectories: int = 10
    """Trajectories of a row, each in a maze of its own; all rows but the last have the same mazes."""
    frames: int = 2000
    """Frames of a trajectory."""
    rows: tuple[str, ...] = ()
    """Rows to measure, by name; none: all."""
    weights: Path = runs.WEIGHTS
    """Folder with scan/*.safetensors."""

    def __post_init__(self) -> None:
        known = (*CONDITIONS, OWN_SCANNER)
        if unknown := [row for row in self.rows if row not in known]:
            raise ValueError(f"rows has {', '.join(unknown)}; expected among {', '.join(known)}")


def episodes(row: str, count: int, frames: int) -> Iterator[Episode]:
    """Episodes of a row's scanner in validation mazes, observed as the scan model takes them."""
    world = WORLDS["scan"]
    seeds = list(world.table_seeds("unseen", "validation")[:count])
    if row == OWN_SCANNER:
        own = WORLDS["maze2d"]
        angles = np.linspace(0.5, -0.5, own.image.width) * math.radians(Maze2DConfig().field_of_view_deg)
        for episode in simulate(own, seeds, frames):
            depths = episode.observations[..., 3]
            scans = np.stack([_resampled(world.image, depth, angles) for depth in depths])
            yield dataclasses.replace(episode, observations=scans)
        return
    for seed in seeds:
        rng = np.random.default_rng(seed)
        rows = int(rng.integers(world.rows[0], world.rows[1] + 1))
        size = {"rows": rows, "cols": rows, "extra_openings": int(rng.integers(0, 9))}
        yield record_episode(ScannedMaze(world.image, size, CONDITIONS[row]), world.driver, frames, seed)


def _resampled(image: ImageFormat, depth: np.ndarray, angles: np.ndarray) -> np.ndarray:
    return scan_image(image, depth, angles[0], angles[1] - angles[0], 0.0, math.inf).reshape(-1)


def main(arguments: Arguments) -> dict[str, Any]:
    """Print the table and return it."""
    world = WORLDS["scan"]
    folder = arguments.weights / world.name
    local, place = load_local(folder, world.name)[0], load_place(folder, world.name)[0]
    optimizer = load_optimizer(folder, world.name)[0]
    names = arguments.rows or (*CONDITIONS, OWN_SCANNER)
    columns = ["path m", *(f"{kind} {unit}" for kind in ("odometry", "corrected") for unit in ("m", "%", "deg"))]
    table = Table(title=f"scan, {arguments.trajectories} validation mazes of {arguments.frames} frames: mean")
    for column in ("", *columns):
        table.add_column(column)
    result: dict[str, Any] = {}
    with tqdm(total=len(names) * arguments.trajectories) as bar:
        for row in names:
            errors: dict[str, list[TrajectoryError]] = {"odometry": [], "corrected": []}
            lengths = []
            for episode in episodes(row, arguments.trajectories, arguments.frames):
                features = features_of(world, episode, folder, (local, place))
                arrays = [torch.from_numpy(features[name]) for name in OPTIMIZER_INPUTS]
                corrected = optimize_offline(optimizer, place.pair_head, *arrays).poses[0]
                for name, poses in (("odometry", se2.r2g(arrays[0])), ("corrected", corrected)):
                    from_origin = np.concatenate((np.zeros((1, 3)), poses.numpy()))
                    errors[name].append(trajectory_error(from_origin, episode.poses_xyyaw))
                lengths.append(path_length_m(episode.poses_xyyaw))
                bar.update()
            means = {
                name: np.mean([dataclasses.astuple(error) for error in found], 0) for name, found in errors.items()
            }
            fields = [field.name for field in dataclasses.fields(TrajectoryError)]
            better = sum(
                c.position_rmse_m < o.position_rmse_m
                for o, c in zip(errors["odometry"], errors["corrected"], strict=True)
            )
            result[row] = {
                "path_m": float(np.mean(lengths)),
                **{name: dict(zip(fields, map(float, mean), strict=True)) for name, mean in means.items()},
                "corrected_better_in": better,
            }
            values = (np.mean(lengths), *means["odometry"], *means["corrected"])
            table.add_row(row, *(f"{value:.2f}" for value in values))
    Console().print(table)
    print(json.dumps(result))
    return result


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
