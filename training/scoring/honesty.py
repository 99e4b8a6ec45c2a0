"""How honest deviations are: shares of poses whose truth lies within three of their own deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ngo_estimator.frontend.camera.local_odometry import LocalEstimate, LocalOdometry
from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.data.batches import seen_from_first
from training.data.faults import SensedDrive

WITHIN = 3.0
"""Deviations."""

_STAMP_NS = 1_000_000_000


@dataclass(frozen=True)
class HonestRun:
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


def honest_run(local: LocalOdometry, online: OnlineTrajectory, drive: SensedDrive) -> HonestRun:
    """Run a drive through both estimators, which begin anew."""
    truth = seen_from_first(drive.poses_xyyaw)[1:]
    steps = estimates_of(local, drive)
    online.reset()
    published, covariances = [], []
    for step in steps:
        update = online.update(step)
        published.append(update.pose_xyyaw)
        covariances.append(update.covariance)
    online.finish()
    trajectory = online.trajectory()
    assert trajectory is not None
    odometry = np.stack([step.odom_xyyaw for step in steps])
    of_odometry = odometry_covariances(odometry, steps)
    return HonestRun(
        rmse_m(odometry, truth),
        rmse_m(trajectory.poses_xyyaw[1:], truth),
        within(odometry, of_odometry, truth),
        within(np.stack(published), np.stack(covariances), truth),
        _median_deviation(np.stack(covariances)),
        _median_deviation(of_odometry),
        float(np.mean([step.unlikeness > 1.0 for step in steps])),
        float(np.mean([step.repeated for step in steps])),
    )


def odometry_covariances(odometry: np.ndarray, steps: list[LocalEstimate]) -> np.ndarray:
    """Covariances ``(n, 3, 3)`` of the poses in ``odom``, as ``local_node`` publishes them."""
    covariance, found = np.zeros((3, 3)), []
    for pose, step in zip(odometry, steps, strict=True):
        covariance = propagate(covariance, pose, step.relative_xyyaw, step.covariance)
        found.append(covariance)
    return np.stack(found)


def within(poses: np.ndarray, covariances: np.ndarray, truth: np.ndarray) -> float:
    """Share of poses ``(n, 3)`` with x, y and heading each within three of their own deviations of the truth."""
    off = np.abs(poses - truth)
    off[:, 2] = np.abs(np.remainder(poses[:, 2] - truth[:, 2] + np.pi, 2.0 * np.pi) - np.pi)
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return float((off <= WITHIN * deviations).all(axis=1).mean())


def rmse_m(poses: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square error of positions."""
    return float(np.sqrt(np.square(poses[:, :2] - truth[:, :2]).sum(axis=1).mean()))


def _median_deviation(covariances: np.ndarray) -> float:
    return float(np.median(np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1])))
