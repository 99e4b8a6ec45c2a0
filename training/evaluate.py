"""Measure a world's shipped networks on whole trajectories of a split, odometry against corrected.

    python -m training.evaluate --world maze2d --split validation

The last line printed is the table as one JSON object.
"""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from ngo_estimator import se2
from ngo_estimator.checkpoint import load_local, load_optimizer, load_place
from ngo_estimator.online_trajectory import optimize_offline
from training import runs
from training.featurise import features_of
from training.metrics import TrajectoryError, trajectory_error
from training.streams import simulate
from training.worlds import TEST_SEEDS, VALIDATION_SEEDS, WorldName, world_named

_SPLITS = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}


@dataclass(frozen=True)
class Arguments:
    """Settings of an evaluation."""

    world: WorldName
    """World to measure in."""
    split: Literal["validation", "test"] = "validation"
    """Mazes to measure on."""
    trajectories: int = 20
    """Trajectories, each in a maze of its own."""
    frames: int = 0
    """Frames of a trajectory; 0 for the world's own (2D 2000, 3D 1000)."""
    weights: Path = runs.WEIGHTS
    """Folder with WORLD/*.safetensors."""


def main(arguments: Arguments) -> dict[str, object]:
    """Print the table and return it."""
    world = world_named(arguments.world)
    folder = arguments.weights / world.name
    local, place = load_local(folder, world.name)[0], load_place(folder, world.name)[0]
    optimizer = load_optimizer(folder, world.name)[0]
    seeds = list(_SPLITS[arguments.split][: arguments.trajectories])
    frames = arguments.frames or world.episode_frames
    errors: dict[str, list[TrajectoryError]] = {"odometry": [], "corrected": []}
    with tqdm(total=len(seeds), desc=f"{world.name} {arguments.split}") as bar:
        for group in (seeds[i : i + 8] for i in range(0, len(seeds), 8)):
            for episode in simulate(world, group, frames):
                arrays = {
                    k: torch.from_numpy(v) for k, v in features_of(world, episode, folder, (local, place)).items()
                }
                order = ("relative", "log_std", "motion", "codes")
                corrected = optimize_offline(optimizer, place.pair_head, *(arrays[name] for name in order)).poses[0]
                for name, poses in (("odometry", se2.r2g(arrays["relative"])), ("corrected", corrected)):
                    from_origin = np.concatenate((np.zeros((1, 3)), poses.numpy()))
                    errors[name].append(trajectory_error(from_origin, episode.poses_xyyaw))
                bar.update()
    table = Table(title=f"{world.name}, {len(seeds)} {arguments.split} mazes of {frames} frames: mean (median)")
    columns = [field.name for field in dataclasses.fields(TrajectoryError)]
    for column in ("", *columns):
        table.add_column(column)
    result: dict[str, object] = {
        "world": world.name,
        "split": arguments.split,
        "trajectories": len(seeds),
        "frames": frames,
    }
    for name, found in errors.items():
        values = np.array([dataclasses.astuple(error) for error in found])
        table.add_row(name, *(f"{m:.3f} ({d:.3f})" for m, d in zip(values.mean(0), np.median(values, 0), strict=True)))
        result[name] = {column: float(mean) for column, mean in zip(columns, values.mean(0), strict=True)}
    wins = sum(
        c.position_rmse_m < o.position_rmse_m for o, c in zip(errors["odometry"], errors["corrected"], strict=True)
    )
    result["corrected_better_in"] = wins
    Console().print(table)
    print(json.dumps(result))
    return result


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
