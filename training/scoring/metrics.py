"""The error of an estimated trajectory against the truth."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry import se2
from training.data.batches import seen_from_first

WITHIN_DEVIATIONS = 3.0  # Deviations within which an honest estimate has the truth.


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


def off_by(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Differences ``(n, 3)`` of poses and truth ``(n, 3)``, headings within half a turn."""
    off = poses - truth
    off[:, 2] = np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(off)


def within(poses: np.ndarray, covariances: np.ndarray, truth: np.ndarray) -> float:
    """Share of poses ``(n, 3)`` with x, y and heading each within three of their own deviations of the truth."""
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return float((np.abs(off_by(poses, truth)) <= WITHIN_DEVIATIONS * deviations).all(axis=1).mean())


def absolute_error_m(estimate_xyyaw: np.ndarray, reference_xyyaw: np.ndarray) -> float:
    """Root mean square distance of positions, both ``(n, 3)``, after the planar rigid motion that makes it least."""
    fits = rigid_motion(estimate_xyyaw[:, :2], reference_xyyaw[:, :2])
    return position_rmse_m(se2.compose(fits, estimate_xyyaw), reference_xyyaw)


def rigid_motion(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """The planar motion ``(3,)`` that carries points ``(n, 2)`` onto others with the least squares."""
    middle, other = points.mean(axis=0), onto.mean(axis=0)
    (x, y), (u, v) = (points - middle).T, (onto - other).T
    yaw = float(np.arctan2((x * v - y * u).sum(), (x * u + y * v).sum()))
    return np.array((*(other - se2.rotate(yaw, middle)), yaw))


def position_rmse_m(poses: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square distance of positions, of poses ``(n, 3)`` of one frame."""
    return float(np.sqrt(np.square(poses[:, :2] - truth[:, :2]).sum(axis=1).mean()))


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.square(values).mean()))
