"""What the tables of results measure on each trajectory of a world."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from ngo_estimator import se2
from training.worlds import World


@dataclass(frozen=True)
class Errors:
    """Errors of estimated trajectories whose first pose is the truth's, without any other alignment.

    ``position_m`` and ``heading_rad`` ``(trajectories, frames)``, the first frame, where they vanish, included;
    ``path_m`` ``(trajectories,)``, the length of the path that was driven.
    """

    position_m: np.ndarray
    heading_rad: np.ndarray
    path_m: np.ndarray


@dataclass(frozen=True)
class Metric:
    """A column of a table: its key in the JSON, what it is, its unit, and how to get it for each trajectory."""

    key: str
    title: str
    unit: str
    of: Callable[[Errors, World], np.ndarray]


def _position_rmse_m(errors: Errors, _: World) -> np.ndarray:
    return np.sqrt(np.mean(errors.position_m**2, axis=1))


def _heading_rmse_deg(errors: Errors, _: World) -> np.ndarray:
    return np.degrees(np.sqrt(np.mean(errors.heading_rad**2, axis=1)))


def _final_percent(errors: Errors, _: World) -> np.ndarray:
    return 100.0 * errors.position_m[:, -1] / errors.path_m


METRICS: dict[str, tuple[Metric, ...]] = {
    "maze2d": (
        Metric(
            "position_rmse",
            "Position RMSE",
            "corridor widths",
            lambda errors, world: _position_rmse_m(errors, world) / world.block_m,
        ),
        Metric(
            "position_percent",
            "Position RMSE",
            "% of the path",
            lambda errors, world: 100.0 * _position_rmse_m(errors, world) / errors.path_m,
        ),
        Metric("final_percent", "Final error", "% of the path", _final_percent),
        Metric("heading_rmse_deg", "Heading RMSE", "deg", _heading_rmse_deg),
    ),
    "maze3d": (
        Metric("translation_percent", "Final error", "% of the path", _final_percent),
        Metric(
            "rotation_deg_per_m",
            "Final heading error",
            "deg/m",
            lambda errors, _: np.degrees(errors.heading_rad[:, -1]) / errors.path_m,
        ),
        Metric("position_rmse_m", "Position RMSE", "m", _position_rmse_m),
    ),
}
"""The metrics of each world; the first is the one that comparisons and figures are about."""


def in_sentence(title: str) -> str:
    """A metric's title within a sentence."""
    return title[0].lower() + title[1:]


def errors_of(estimate: np.ndarray, truth: np.ndarray) -> Errors:
    """Errors of estimated poses ``(trajectories, steps, 3)`` after each step, seen from the first frame."""
    if estimate.shape != truth.shape or truth.ndim != 3 or truth.shape[2] != 3:
        raise ValueError(
            f"trajectories are {estimate.shape} and {truth.shape}; expected two of the same (trajectories, steps, 3)"
        )
    with_origin = np.concatenate((np.zeros_like(truth[:, :1]), truth), axis=1)
    path_m = np.linalg.norm(np.diff(with_origin[..., :2], axis=1), axis=2).sum(axis=1)
    if path_m.min() <= 0.0:
        raise ValueError("a true path has no length; expected ones that move")
    turn = se2.wrap(torch.from_numpy(np.asarray(estimate[..., 2] - truth[..., 2], dtype=np.float64))).numpy()
    first = np.zeros((len(truth), 1))
    distance = np.linalg.norm(estimate[..., :2] - truth[..., :2], axis=2)
    return Errors(np.concatenate((first, distance), axis=1), np.concatenate((first, np.abs(turn)), axis=1), path_m)


def scores(estimate: np.ndarray, truth: np.ndarray, world: World) -> dict[str, np.ndarray]:
    """Every metric of a world ``(trajectories,)`` by its key; arguments as in ``errors_of``."""
    errors = errors_of(estimate, truth)
    return {metric.key: metric.of(errors, world) for metric in METRICS[world.name]}
