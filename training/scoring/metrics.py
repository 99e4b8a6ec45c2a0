"""The error of an estimated trajectory against the truth."""

from dataclasses import dataclass

import numpy as np

from training.data.batches import seen_from_first


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of a trajectory whose first pose is the truth's: no other alignment is made.

    ``position_rmse_m`` and ``heading_rmse_deg`` over all frames; ``final_percent``, the distance between the two last
    positions in percent of the path driven.
    """

    position_rmse_m: float
    final_percent: float
    heading_rmse_deg: float


def path_length_m(poses_xyyaw: np.ndarray) -> float:
    """Length of the path through ``(frames, 3)`` poses."""
    return float(np.linalg.norm(np.diff(poses_xyyaw[:, :2], axis=0), axis=1).sum())


def trajectory_error(estimate_xyyaw: np.ndarray, truth_xyyaw: np.ndarray) -> TrajectoryError:
    """Errors of ``estimate_xyyaw`` against ``truth_xyyaw``, both ``(frames, 3)`` of the same frames."""
    estimate_xyyaw, truth_xyyaw = np.asarray(estimate_xyyaw), np.asarray(truth_xyyaw)
    if estimate_xyyaw.shape != truth_xyyaw.shape or truth_xyyaw.ndim != 2 or truth_xyyaw.shape[1] != 3:
        raise ValueError(
            f"trajectories are {estimate_xyyaw.shape} and {truth_xyyaw.shape}; expected two of the same (frames, 3)"
        )
    length = path_length_m(truth_xyyaw)
    if length <= 0.0:
        raise ValueError("the true path has no length; expected one that moves")
    estimate, truth = seen_from_first(estimate_xyyaw), seen_from_first(truth_xyyaw)
    position = np.linalg.norm(estimate[:, :2] - truth[:, :2], axis=1)
    heading = np.remainder(estimate[:, 2] - truth[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return TrajectoryError(
        position_rmse_m=float(np.sqrt(np.mean(position**2))),
        final_percent=float(100.0 * position[-1] / length),
        heading_rmse_deg=float(np.degrees(np.sqrt(np.mean(heading**2)))),
    )
