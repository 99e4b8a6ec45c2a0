"""Measure the odometry of local networks alone on validation mazes: of a step, over many steps, and of whole drives.

    python -m training.evaluate_odometry --world maze3d
    python -m training.evaluate_odometry --world maze3d --driver learned --weights FOLDER OTHER_FOLDER

The last line is the result as one JSON object, one entry for each folder of weights.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

from ngo_estimator.checkpoint import load_local
from ngo_estimator.local_pose_network import LocalPoseNetwork
from training import runs
from training.results_page import interval, markdown
from training.statistics import mean_interval, rms_interval
from training.validation_steps import estimated_steps, odometry_error, step_errors, true_steps, validation_episodes
from training.worlds import World, world_named

_RPE_STEPS = 100


@dataclass(frozen=True)
class Arguments:
    """Which networks are measured, and where."""

    world: Literal["maze2d", "maze3d"]
    """World to drive in."""
    weights: tuple[Path, ...] = (runs.WEIGHTS,)
    """Folders with WORLD/local_pose_network.safetensors."""
    driver: str | None = None
    """Driver; none: the world's."""
    mazes: int = 24
    """Validation mazes."""
    frames: int = 1000
    """Frames in each."""

    def __post_init__(self) -> None:
        if self.frames <= _RPE_STEPS:
            raise ValueError(f"frames is {self.frames}; expected more than {_RPE_STEPS}")


def measured(network: LocalPoseNetwork, world: World, mazes: int, frames: int) -> dict[str, Any]:
    """Errors with intervals over the mazes.

    RMSE of a step (m, deg), relative pose error of the heading over 100 steps (deg, RMS of all such windows), and the
    final error (% of the path).
    """
    squares, over_many, final_percent = [], [], []
    for episode in tqdm(validation_episodes(world, mazes, frames), total=mazes, unit="maze"):
        estimated, true = estimated_steps(network, world, episode), true_steps(episode)
        errors = step_errors(estimated, true)
        squares.append(np.square(errors).sum(axis=0))
        sums = np.concatenate(([0.0], np.cumsum(errors[:, 1])))
        over_many.append(np.square(sums[_RPE_STEPS:] - sums[:-_RPE_STEPS]).sum())
        final_percent.append(odometry_error(estimated, true).final_percent)
    totals, steps = np.array(squares), float(frames - 1)
    return {
        "rmse_m": rms_interval(totals[:, 0], np.full(mazes, steps)).as_json(),
        "rmse_deg": rms_interval(totals[:, 1], np.full(mazes, steps)).as_json(),
        "rpe_100_deg": rms_interval(np.array(over_many), np.full(mazes, frames - _RPE_STEPS)).as_json(),
        "final_percent": mean_interval(np.array(final_percent)).as_json(),
    }


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, print a table and the JSON, and return it."""
    world = world_named(arguments.world)
    world = world if arguments.driver is None else dataclasses.replace(world, driver=arguments.driver)
    networks = []
    for folder in arguments.weights:
        network, description = load_local(folder / world.name, world.name)
        found = measured(network.eval(), world, arguments.mazes, arguments.frames)
        networks.append({"sha256": description["sha256"], "training": description["training"]["command"], **found})
    rows = [
        [
            f"`{one['training']}`, {one['sha256'][:8]}",
            *(interval(one[key]) for key in ("rmse_deg", "rmse_m", "rpe_100_deg", "final_percent")),
        ]
        for one in networks
    ]
    header = ["Network", "Step, deg", "Step, m", f"{_RPE_STEPS} steps, deg", "Final error, %"]
    print(markdown(header, rows))
    result = {
        "world": world.name,
        "driver": world.driver,
        "mazes": arguments.mazes,
        "frames": arguments.frames,
        "networks": networks,
    }
    print(json.dumps(result))
    return result


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
