"""The metrics of the tables of results, for each trajectory of a world."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry import se2
from ngo_estimator.trajectory.errors import segment_errors
from ngo_estimator.trajectory.files import SpatialPoses
from training.data.worlds import World
from training.scoring.metrics import path_length_m, trajectory_error
from training.scoring.online_estimate import with_origin

SEGMENTS_M = (5.0, 10.0, 20.0, 40.0)
"""Lengths of KITTI's segments that fit 3D mazes, which are 27 to 39 m wide: less than two blocks, to a whole side."""


@dataclass(frozen=True)
class Metric:
    """A column of a table: its key in the JSON, what it is, and its unit."""

    key: str
    title: str
    unit: str


METRICS: dict[str, tuple[Metric, ...]] = {
    "maze2d": (
        Metric("position_rmse", "Position RMSE", "corridor widths"),
        Metric("position_percent", "Position RMSE", "% of the path"),
        Metric("final_percent", "Final error", "% of the path"),
        Metric("heading_rmse_deg", "Heading RMSE", "deg"),
    ),
    "maze3d": (
        Metric("translation_percent", "Final error", "% of the path"),
        Metric("rotation_deg_per_m", "Final heading error", "deg/m"),
        Metric("position_rmse_m", "Position RMSE", "m"),
        Metric("heading_rmse_deg", "Heading RMSE", "deg"),
        Metric("segment_translation_percent", "Segment error", "%"),
        Metric("segment_rotation_deg_per_m", "Segment heading error", "deg/m"),
    ),
}
METRICS["doom"] = METRICS["maze3d"]
"""The metrics of each world; the first is the one that comparisons and figures are about."""


def in_sentence(title: str) -> str:
    """A metric's title within a sentence."""
    return title[0].lower() + title[1:]


def scores(estimate: np.ndarray, truth: np.ndarray, world: World) -> dict[str, np.ndarray]:
    """Every metric of a world ``(trajectories,)`` by its key.

    Args:
        estimate, truth: poses ``(trajectories, steps, 3)`` after each step, seen from the first frame.
    """
    if len(estimate) != len(truth):
        raise ValueError(f"{len(estimate)} and {len(truth)} trajectories are given; expected the same ones")
    found = [_scores(with_origin(one), with_origin(true), world) for one, true in zip(estimate, truth, strict=True)]
    return {metric.key: np.array([each[metric.key] for each in found]) for metric in METRICS[world.name]}


def _scores(estimate: np.ndarray, truth: np.ndarray, world: World) -> dict[str, float]:
    """Of poses ``(frames, 3)``, the first frame among them."""
    error, path_m = trajectory_error(estimate, truth), path_length_m(truth)
    if world.name == "maze2d":
        return {
            "position_rmse": error.position_rmse_m / world.block_m,
            "position_percent": 100.0 * error.position_rmse_m / path_m,
            "final_percent": error.final_percent,
            "heading_rmse_deg": error.heading_rmse_deg,
        }
    segments = segment_errors(_spatial(estimate), _spatial(truth), SEGMENTS_M)
    return {
        "translation_percent": error.final_percent,
        "rotation_deg_per_m": abs(float(np.degrees(se2.wrap(estimate[-1, 2] - truth[-1, 2])))) / path_m,
        "position_rmse_m": error.position_rmse_m,
        "heading_rmse_deg": error.heading_rmse_deg,
        "segment_translation_percent": segments.translation_percent,
        "segment_rotation_deg_per_m": segments.rotation_deg_per_m,
    }


def _spatial(poses: np.ndarray) -> SpatialPoses:
    """Poses ``(frames, 3)`` in the plane as poses in space; segments do not ask for their stamps."""
    return SpatialPoses.from_planar(np.arange(len(poses), dtype=np.int64), np.asarray(poses, dtype=np.float64))
