"""How consistent deviations are: shares of poses whose truth lies within three of their own deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ngo_estimator.frontend.camera.local_odometry import LocalEstimate, LocalOdometry
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.data.batches import seen_from_first
from training.data.faults import SensedDrive
from training.scoring.metrics import position_rmse_m, within
from training.scoring.online_estimate import carried_covariances, online_run

_STAMP_NS = 1_000_000_000


@dataclass(frozen=True)
class ConsistencyRun:
    """One drive through both estimators.

    ``odometry_m``, ``corrected_m``: position RMSE. ``within_odometry``, ``within_published``: shares of the poses of
    ``odom`` and of ``ngo/pose``, as they were published, whose x, y and heading are each within three of their own
    deviations of the truth. ``deviation_m``, ``odometry_deviation_m``: medians of what they state of the position.
    ``unfamiliar``, ``repeated``: shares of the frames.
    """

    odometry_m: float
    corrected_m: float
    within_odometry: float
    within_published: float
    deviation_m: float
    odometry_deviation_m: float
    unfamiliar: float
    repeated: float


def estimates_of(local: LocalOdometry, drive: SensedDrive) -> list[LocalEstimate]:
    """What the local odometry, which begins anew, makes of a drive."""
    local.reset()
    found = []
    for number, image in enumerate(drive.images.numpy()):
        action = int(drive.actions[number - 1]) if number and drive.actions is not None and local.uses_action else None
        twist = drive.twists[number - 1] if number and drive.twists is not None and local.uses_twist else None
        stamp = _STAMP_NS + round(number * local.period_s * 1e9)
        estimate = local.update(stamp, image, action, twist)
        if estimate is not None:
            found.append(estimate)
    return found


def consistency_run(local: LocalOdometry, online: OnlineTrajectory, drive: SensedDrive) -> ConsistencyRun:
    """Run a drive through both estimators, which begin anew."""
    truth = seen_from_first(drive.poses_xyyaw)[1:]
    steps = estimates_of(local, drive)
    run = online_run(online, steps)
    odometry = np.stack([step.odom_xyyaw for step in steps])
    of_odometry = odometry_covariances(odometry, steps)
    return ConsistencyRun(
        position_rmse_m(odometry, truth),
        position_rmse_m(run.trajectory.poses_xyyaw[1:], truth),
        within(odometry, of_odometry, truth),
        within(run.published, run.covariances, truth),
        _median_deviation(run.covariances),
        _median_deviation(of_odometry),
        float(np.mean([step.unlikeness > 1.0 for step in steps])),
        float(np.mean([step.repeated for step in steps])),
    )


def odometry_covariances(odometry: np.ndarray, steps: list[LocalEstimate]) -> np.ndarray:
    """Covariances ``(n, 3, 3)`` of the poses in ``odom``, as ``local_node`` publishes them."""
    relative, covariances = ([getattr(step, name) for step in steps] for name in ("relative_xyyaw", "covariance"))
    return carried_covariances(odometry, np.stack(relative), np.stack(covariances))


def _median_deviation(covariances: np.ndarray) -> float:
    return float(np.median(np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1])))
