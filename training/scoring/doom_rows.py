"""The rows of the table of Doom maps: poses of a drive, each with the covariance that is published with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.baselines.loop_factors import found_loops
from training.baselines.pose_graph import PoseGraphSettings, optimize
from training.data.batches import alike
from training.scoring.metrics import absolute_error_m, trajectory_error, within
from training.scoring.online_estimate import carried_covariances, online_run, steps_of, with_origin
from training.scoring.row_estimators import seen_in

ROWS = ("local", "gtsam", "ours")
METRICS = ("translation_percent", "ate_m", "within_3_std")

_AGO = 48

Features = dict[str, np.ndarray]  # Of one drive, as of ``features_of``.


@dataclass(frozen=True)
class Estimate:
    """``poses`` ``(steps, 3)`` of a drive in the end; ``published`` ``(steps, 3)``, each as it was when it was new.

    ``covariances`` ``(steps, 3, 3)`` are those published. All are seen from the first frame.
    """

    poses: np.ndarray
    published: np.ndarray
    covariances: np.ndarray


def odometry(relative: np.ndarray, covariances: np.ndarray) -> Estimate:
    """The trajectory of steps ``(steps, 3)``, each with its covariance ``(3, 3)``, independent of the others."""
    poses = se2.r2g(torch.from_numpy(relative).double()).numpy()
    return Estimate(poses, poses, carried_covariances(poses, relative.astype(np.float64), covariances))


def local(features: Features) -> Estimate:
    """The odometry of the local network, as ``local_node`` publishes it."""
    variances = np.exp(2.0 * features["log_std"].astype(np.float64))
    return odometry(features["relative"], variances[:, None] * np.eye(3))


def gtsam_graph(settings: PoseGraphSettings, pair_head: PairHead) -> Callable[[Features], Estimate]:
    """GTSAM on the same odometry and loops, at the end of a drive; its covariance is that of the odometry."""

    def estimate(features: Features) -> Estimate:
        whole = len(features["relative"]) // settings.block * settings.block
        batch = {name: value[None, :whole] for name, value in features.items() if name != "origin_code"}
        batch["origin_code"] = features["origin_code"][None]
        seen = seen_in(batch, settings.calibrated(batch["relative"]))
        loops = found_loops(pair_head, seen, settings.search, settings.block)[0]
        poses = optimize(batch["relative"][0], batch["log_std"][0], loops, settings)
        tail = se2.r2g(torch.from_numpy(settings.calibrated(features["relative"][whole:])))
        if len(tail):
            poses = np.concatenate((poses, se2.compose(torch.from_numpy(poses[-1:]), tail).numpy()))
        by = np.array([settings.odometry_position_scale] * 2 + [settings.odometry_heading_scale]) ** 2
        variances = by * np.exp(2.0 * features["log_std"].astype(np.float64))
        return Estimate(poses, poses, odometry(features["relative"], variances[:, None] * np.eye(3)).covariances)

    return estimate


def ours(core: OnlineTrajectory) -> Callable[[Features], Estimate]:
    """The online core, as ``ngo_node`` publishes it."""

    def estimate(features: Features) -> Estimate:
        run = online_run(core, steps_of(features))
        return Estimate(run.trajectory.poses_xyyaw[1:], run.published, run.covariances)

    return estimate


def returning(truth: np.ndarray, radius_m: float, angle_rad: float) -> float:
    """Share of every eighth pose from which one ``_AGO`` steps or more ago is so near, in position and heading.

    Args:
        truth: true poses ``(steps, 3)``.
    """
    poses = truth[7::8]
    earlier = np.tri(len(poses), k=-(_AGO // 8), dtype=bool)
    return float((alike(poses, radius_m, angle_rad) & earlier).any(axis=1).mean())


def errors_of(estimate: Estimate, truth: np.ndarray) -> dict[str, float]:
    """``METRICS`` of an estimate, true poses ``(steps, 3)`` seen from the first frame.

    The final error in percent of the path; the root mean square distance (m) after the best rigid alignment; and the
    share of the published poses whose x, y and heading each lie within three of their deviations of the truth.
    """
    true, found = with_origin(truth), with_origin(estimate.poses)
    return {
        "translation_percent": trajectory_error(found, true).final_percent,
        "ate_m": absolute_error_m(found, true),
        "within_3_std": within(estimate.published, estimate.covariances, truth),
    }
