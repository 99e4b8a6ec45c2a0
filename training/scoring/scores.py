"""The metrics of the tables of results, for each trajectory of a world."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.trajectory.errors import SegmentErrors, segment_errors
from ngo_estimator.trajectory.files import SpatialPoses
from training.data.worlds import World

SEGMENTS_M = (5.0, 10.0, 20.0, 40.0)
"""Lengths of KITTI's segments that fit 3D mazes, which are 27 to 39 m wide: less than two blocks, to a whole side."""


@dataclass(frozen=True)
class Errors:
    """Errors of estimated trajectories whose first pose is the truth's, without any other alignment.

    ``position_m`` and ``heading_rad`` ``(trajectories, frames)``, the first frame, where they vanish, included;
    ``path_m`` ``(trajectories,)``, the length of the path that was driven; ``estimate`` and ``truth`` ``(trajectories,
    frames, 3)``, the poses themselves.
    """

    position_m: np.ndarray
    heading_rad: np.ndarray
    path_m: np.ndarray
    estimate: np.ndarray
    truth: np.ndarray

    @cached_property
    def segments(self) -> list[SegmentErrors]:
        """The segment errors of KITTI of each trajectory, at ``SEGMENTS_M``."""
        return [
            segment_errors(_spatial(estimate), _spatial(truth), SEGMENTS_M)
            for estimate, truth in zip(self.estimate, self.truth, strict=True)
        ]


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
        Metric("heading_rmse_deg", "Heading RMSE", "deg", _heading_rmse_deg),
        Metric(
            "segment_translation_percent",
            "Segment error",
            "%",
            lambda errors, _: np.array([found.translation_percent for found in errors.segments]),
        ),
        Metric(
            "segment_rotation_deg_per_m",
            "Segment heading error",
            "deg/m",
            lambda errors, _: np.array([found.rotation_deg_per_m for found in errors.segments]),
        ),
    ),
}
METRICS["doom"] = METRICS["maze3d"]
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
    from_origin = [np.concatenate((np.zeros_like(poses[:, :1]), poses), axis=1) for poses in (estimate, truth)]
    path_m = np.linalg.norm(np.diff(from_origin[1][..., :2], axis=1), axis=2).sum(axis=1)
    if path_m.min() <= 0.0:
        raise ValueError("a true path has no length; expected ones that move")
    turn = se2.wrap(torch.from_numpy(np.asarray(estimate[..., 2] - truth[..., 2], dtype=np.float64))).numpy()
    first = np.zeros((len(truth), 1))
    distance = np.linalg.norm(estimate[..., :2] - truth[..., :2], axis=2)
    position, heading = (np.concatenate((first, error), axis=1) for error in (distance, np.abs(turn)))
    return Errors(position, heading, path_m, *from_origin)


def _spatial(poses: np.ndarray) -> SpatialPoses:
    """Poses ``(frames, 3)`` in the plane as poses in space; segments do not ask for their stamps."""
    return SpatialPoses.from_planar(np.arange(len(poses), dtype=np.int64), np.asarray(poses, dtype=np.float64))


def scores(estimate: np.ndarray, truth: np.ndarray, world: World) -> dict[str, np.ndarray]:
    """Every metric of a world ``(trajectories,)`` by its key; arguments as in ``errors_of``."""
    errors = errors_of(estimate, truth)
    return {metric.key: metric.of(errors, world) for metric in METRICS[world.name]}
