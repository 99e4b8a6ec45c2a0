"""Fit the covariance of the corrected pose to its errors on validation mazes.

    python -m training.calibrate_covariance --world maze3d

The optimizer treats errors of steps and loops as independent. They are not, so its covariance is too small. One factor
corrects this: the mean normalised squared error of the newest pose (1 where the covariance is right). It goes into the
description of the weights.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from ngo_estimator.checkpoint import OPTIMIZER, load_local, load_optimizer, load_place
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.common import records
from training.common.command_line import run_command
from training.common.training import save_weights
from training.data.episodes import simulate
from training.data.features import features_of
from training.data.worlds import VALIDATION_SEEDS, WorldName, world_named
from training.scoring.online_estimate import steps_of


@dataclass(frozen=True)
class Arguments:
    """Settings of a calibration."""

    world: WorldName  # World whose optimizer is calibrated.
    trajectories: int = 12  # Trajectories, each in a validation maze of its own.
    frames: int = 0  # Frames of a trajectory; 0 for the world's own (2D 2000, 3D 1000).
    weights: Path = records.WEIGHTS  # Folder with WORLD/*.safetensors; the optimizer's description gets the factor.


def main(arguments: Arguments) -> float:
    """Write the factor into the description, and return it."""
    world = world_named(arguments.world)
    folder = arguments.weights / world.name
    networks = load_local(folder, world.name)[0], load_place(folder, world.name)[0]
    optimizer, description = load_optimizer(folder, world.name)
    plain = dataclasses.replace(optimizer.config, covariance_scale=1.0)
    optimizer.config = plain
    core = OnlineTrajectory(optimizer, networks[1].pair_head if plain.loops else None)
    found = []
    seeds, frames = list(VALIDATION_SEEDS[-arguments.trajectories :]), arguments.frames or world.episode_frames
    for group in (seeds[i : i + 4] for i in range(0, len(seeds), 4)):
        for episode in tqdm(simulate(world, group, frames), total=len(group), desc=world.name):
            features = features_of(world, episode, folder, networks)
            found.append(normalized_errors(core, features))
    scale = float(np.mean(np.concatenate(found)))
    optimizer.config = dataclasses.replace(plain, covariance_scale=scale)
    save_weights(folder, optimizer, OPTIMIZER, records.kept_details(description))
    print(f"{world.name}: squared errors are {scale:.2f} times the covariance, which gets this factor")
    return scale


def normalized_errors(core: OnlineTrajectory, features: dict[str, np.ndarray]) -> np.ndarray:
    """Squared errors of the newest pose in units of its covariance ``(n,)``, after each optimisation; 1 is right."""
    core.reset()
    result = []
    for step, truth in zip(steps_of(features), features["truth"], strict=True):
        update = core.update(step)
        if update.optimized:
            error = update.pose_xyyaw - truth
            error[2] = np.angle(np.exp(1j * error[2]))
            result.append(error @ np.linalg.solve(update.covariance, error) / 3.0)
    return np.array(result)


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
