"""Episodes in validation mazes, and the errors of local networks on their steps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from ngo_estimator.geometry import se2
from ngo_estimator.networks.local_pose_network import LocalPoseNetwork
from training.data import episodes
from training.data.batches import action_histories
from training.data.worlds import VALIDATION_SEEDS, World
from training.scoring.metrics import TrajectoryError, trajectory_error
from training.scoring.online_estimate import with_origin
from training.scoring.statistics import mean_interval, rms_interval

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

_TOGETHER = 128  # pairs of frames that go through a network at once


def validation_episodes(world: World, mazes: int, frames: int) -> Iterator[Episode]:
    """Episodes of the world's driver in the first so many validation mazes, whose sizes are drawn as in training."""
    if not 2 <= mazes <= len(VALIDATION_SEEDS):
        raise ValueError(f"mazes is {mazes}; expected 2 to {len(VALIDATION_SEEDS)}")
    seeds = list(VALIDATION_SEEDS[:mazes])
    for first in range(0, mazes, episodes.GROUP):
        yield from episodes.simulate(world, seeds[first : first + episodes.GROUP], frames)


@torch.inference_mode()
def estimated_steps(network: LocalPoseNetwork, world: World, episode: Episode) -> np.ndarray:
    """Relative poses ``(frames - 1, 3)``, float64, that a network of the world estimates along an episode."""
    images = episodes.images_of(world, episode)
    actions = action_histories(episode.actions).split(_TOGETHER)
    pairs = zip(images[:-1].split(_TOGETHER), images[1:].split(_TOGETHER), actions, strict=True)
    told = bool(network.config.actions)
    steps = [network(earlier, later, action if told else None) for earlier, later, action in pairs]
    relative, _ = network.remembered(*(torch.cat(part) for part in zip(*steps, strict=True)))
    return relative.double().numpy()


def true_steps(episode: Episode) -> np.ndarray:
    """The true relative poses ``(frames - 1, 3)``, float64."""
    poses = torch.from_numpy(episode.poses_xyyaw)
    return se2.between(poses[:-1], poses[1:]).numpy()


def step_errors(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Errors ``(steps, 2)`` of steps ``(steps, 3)``: the distance in m, the turn in deg."""
    error = se2.wrapped(torch.from_numpy(estimated - true)).numpy()
    return np.stack((np.hypot(error[:, 0], error[:, 1]), np.degrees(error[:, 2])), axis=1)


def odometry_error(steps: np.ndarray, true: np.ndarray) -> TrajectoryError:
    """The error of the trajectory of steps ``(steps, 3)`` against that of the true ones."""
    estimate, truth = (with_origin(se2.r2g(torch.from_numpy(one)).numpy()) for one in (steps, true))
    return trajectory_error(estimate, truth)


def odometry_errors(
    network: LocalPoseNetwork, world: World, mazes: int, frames: int, rpe_steps: int | None = None
) -> dict[str, Any]:
    """Errors of a local network's odometry on validation mazes, with intervals over them.

    RMSE of a step (m, deg) and the final error (% of the path); with ``rpe_steps`` also the relative pose error of the
    heading over so many steps (deg, RMS of all such windows).
    """
    squares, steps, over_many, windows, final_percent = [], [], [], [], []
    for episode in tqdm(validation_episodes(world, mazes, frames), f"{world.name} odometry", mazes, unit="maze"):
        estimated, true = estimated_steps(network, world, episode), true_steps(episode)
        errors = step_errors(estimated, true)
        squares.append(np.square(errors).sum(axis=0))
        steps.append(float(len(true)))
        final_percent.append(odometry_error(estimated, true).final_percent)
        if rpe_steps is not None:
            sums = np.cumsum([0.0, *errors[:, 1]])
            drifts = sums[rpe_steps:] - sums[:-rpe_steps]
            over_many.append(np.square(drifts).sum())
            windows.append(float(len(drifts)))
    totals, counts = np.array(squares), np.array(steps)
    found = {
        "rmse_m": rms_interval(totals[:, 0], counts).as_json(),
        "rmse_deg": rms_interval(totals[:, 1], counts).as_json(),
        "final_percent": mean_interval(np.array(final_percent)).as_json(),
    }
    if rpe_steps is not None:
        found[f"rpe_{rpe_steps}_deg"] = rms_interval(np.array(over_many), np.array(windows)).as_json()
    return found
