"""What the net keeps of a run through a stored drive, and how good that is."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ngo_estimator.slam.trajectory_update import Trajectory
from training.data.lidar_drives import TruePoses
from training.scoring.lidar_errors import absolute_error_m, covariance_errors

STORED = Path(__file__).parent / "stored"
WEIGHTS = Path(__file__).parents[2] / "ros_ws/src/ngo_estimator/weights"
FIRST_STAMP_NS = 1_000_000_000
JITTER = 1e-6  # By how much at most a copy's ranges differ (m), and the values of its pictures that are no bytes.


@dataclass(frozen=True, eq=False)
class Run:
    """Both estimators over a drive: the finished ``trajectory``, and ``covariances`` ``(n, 3, 3)`` of its poses as
    they were published. ``loops`` are believed at the end."""

    trajectory: Trajectory
    covariances: np.ndarray
    loops: int


@dataclass(frozen=True)
class Scores:
    """How good a run is.

    ``ate_m`` of the corrected path and ``odometry_ate_m``: root mean square distance to the truth after the best rigid
    alignment. ``within``: share of the published poses whose x, y and heading are each within three of their own
    deviations of the truth. ``nll``: their mean negative log likelihood (nats). ``moved_m``: the largest distance from
    the path of the drive as it is stored.
    """

    ate_m: float
    odometry_ate_m: float
    within: float
    nll: float
    moved_m: float


def scores_of(run: Run, truth: TruePoses, path: np.ndarray) -> Scores:
    """Scores of a run, with ``moved_m`` from ``path`` ``(n, 3)``; a run that lost a frame raises ``ValueError``."""
    trajectory, true = run.trajectory, truth.poses_xyyaw
    if not np.array_equal(trajectory.stamps_ns, truth.stamps_ns):
        raise ValueError(f"the run has {len(trajectory.stamps_ns)} poses; expected one of each of {len(true)} frames")
    honesty = covariance_errors(truth, trajectory.stamps_ns, trajectory.online_xyyaw, run.covariances)
    return Scores(
        absolute_error_m(trajectory.poses_xyyaw, true),
        absolute_error_m(trajectory.odometry_xyyaw, true),
        float(honesty["within_three_deviations"][0]),
        float(honesty["negative_log_likelihood"][0]),
        largest_difference(trajectory.poses_xyyaw, path)[0],
    )


def largest_difference(poses: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) between two trajectories."""
    difference = poses - expected
    angle = np.remainder(difference[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return float(np.hypot(difference[:, 0], difference[:, 1]).max()), float(np.abs(angle).max())


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write an ``.npz`` that is smaller than numpy's own by a fifth, and the same each time."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # without a date
            entry.compress_type = zipfile.ZIP_BZIP2
            with archive.open(entry, "w") as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
