"""What networks that were trained in different looks are worth in mazes of one look, on the same episodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from ngo_estimator import se2
from ngo_estimator.checkpoint import PlaceNetworks
from ngo_estimator.local_pose_network import LocalPoseNetwork
from training import train_place
from training.metrics import trajectory_error
from training.online_estimate import with_origin
from training.statistics import compare, mean_interval
from training.streams import PlaceStream, action_histories, images_of, relative_poses, simulate
from training.train_local import estimated, step_metrics
from training.worlds import World

Scores = dict[str, list[float]]
"""Metrics of each maze, or of each group of mazes, by their keys."""


class Metric(NamedTuple):
    """A row of a table: what it is, its unit, and whether less of it is better."""

    title: str
    unit: str
    is_error: bool = True


LOCAL_METRICS = {
    "step_m": Metric("RMSE of a step", "m"),
    "step_deg": Metric("RMSE of a step", "deg"),
    "final_percent": Metric("Final error of the odometry", "% of the path"),
}
PLACE_METRICS = {
    "precision_at_1": Metric("Right partner first", "share", is_error=False),
    "median_m": Metric("Median error of a pair", "m"),
    "median_deg": Metric("Median error of a pair", "deg"),
}
METRICS = {**LOCAL_METRICS, **PLACE_METRICS}


@torch.inference_mode()
def local_scores(
    networks: Mapping[str, LocalPoseNetwork], world: World, seeds: range, frames: int
) -> dict[str, Scores]:
    """``LOCAL_METRICS`` of each network in each of the mazes ``seeds``, every one with a size and a look of its own."""
    scores: dict[str, Scores] = {name: {key: [] for key in LOCAL_METRICS} for name in networks}
    for seed in seeds:
        (episode,) = simulate(world, [seed], frames)
        images, truth = images_of(world, episode), relative_poses(episode.poses_xyyaw)
        pairs = {"earlier": images[:-1], "later": images[1:], "action": action_histories(episode.actions)}
        for name, network in networks.items():
            mean, log_std, _ = estimated(network, pairs)
            steps = step_metrics(mean, log_std, truth)
            estimate = with_origin(se2.r2g(mean.double()).numpy())
            scores[name]["step_m"].append(steps["rmse_m"])
            scores[name]["step_deg"].append(steps["rmse_deg"])
            scores[name]["final_percent"].append(trajectory_error(estimate, episode.poses_xyyaw).final_percent)
    return scores


@torch.inference_mode()
def place_scores(
    networks: Mapping[str, PlaceNetworks], world: World, seeds: range, groups: int, arguments: train_place.Arguments
) -> dict[str, Scores]:
    """``PLACE_METRICS`` of each network, each the mean over the batches of a group of mazes of one size and look."""
    trainings = {name: train_place.PlaceTraining(arguments, world, found).eval() for name, found in networks.items()}
    scores: dict[str, Scores] = {name: {key: [] for key in PLACE_METRICS} for name in networks}
    a_group = PlaceStream(world, seeds, 0, 1, arguments.pairs_a_maze).batches_a_group
    of_group: dict[str, list[list[float]]] = {name: [] for name in networks}
    for batch in PlaceStream(world, seeds, 0, groups * a_group, arguments.pairs_a_maze):
        for name, training in trainings.items():
            figures = training(batch, augment=False)
            of_group[name].append([float(figures[key]) for key in PLACE_METRICS])
            if len(of_group[name]) == a_group:
                for key, value in zip(PLACE_METRICS, np.mean(of_group[name], axis=0), strict=True):
                    scores[name][key].append(float(value))
                of_group[name] = []
    return scores


def table_json(scores: Mapping[str, Scores]) -> dict[str, Any]:
    """Of each metric ``NETWORK.{mean, ci95}``, and the paired ``varied_vs_plain``; of shares the difference alone."""
    table: dict[str, Any] = {}
    for key, metric in METRICS.items():
        values = {name: np.array(found[key]) for name, found in scores.items()}
        plain, varied = values["plain"], values["varied"]
        paired = (
            compare(varied, plain).as_json()
            if metric.is_error
            else {"difference": mean_interval(varied - plain).as_json()}
        )
        means = {name: mean_interval(found).as_json() for name, found in values.items()}
        table[key] = {**means, "varied_vs_plain": paired}
    return table
