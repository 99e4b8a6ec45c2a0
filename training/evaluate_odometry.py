"""Measure the odometry of local networks on validation mazes: single steps, many steps and whole drives.

    python -m training.evaluate_odometry --world maze3d
    python -m training.evaluate_odometry --world maze3d --driver learned --weights FOLDER OTHER_FOLDER

The last line is the result as one JSON object, with one entry for each folder of weights.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from ngo_estimator.checkpoint import load_local
from training.common import records
from training.data.worlds import world_named
from training.report.page import interval, markdown
from training.scoring.validation_steps import odometry_errors
from training.train_local import RPE_STEPS


@dataclass(frozen=True)
class Arguments:
    """Settings of the measurement."""

    world: Literal["maze2d", "maze3d"]  # World to drive in.
    weights: tuple[Path, ...] = (records.WEIGHTS,)  # Folders with WORLD/local_pose_network.safetensors.
    driver: str | None = None  # Driver; none: the world's.
    mazes: int = 24  # Validation mazes.
    frames: int = 1000  # Frames in each.

    def __post_init__(self) -> None:
        if self.frames <= RPE_STEPS:
            raise ValueError(f"frames is {self.frames}; expected more than {RPE_STEPS}")


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, print a table and the JSON, and return it."""
    world = world_named(arguments.world)
    world = world if arguments.driver is None else dataclasses.replace(world, driver=arguments.driver)
    networks = []
    for folder in arguments.weights:
        network, description = load_local(folder / world.name, world.name)
        found = odometry_errors(network.eval(), world, arguments.mazes, arguments.frames, RPE_STEPS)
        networks.append({"sha256": description["sha256"], "training": description["training"]["command"], **found})
    rows = [
        [
            f"`{one['training']}`, {one['sha256'][:8]}",
            *(interval(one[key]) for key in ("rmse_deg", "rmse_m", f"rpe_{RPE_STEPS}_deg", "final_percent")),
        ]
        for one in networks
    ]
    header = ["Network", "Step, deg", "Step, m", f"{RPE_STEPS} steps, deg", "Final error, %"]
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
