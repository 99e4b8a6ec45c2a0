"""How far an estimate is from what is known of a lidar's drive."""

import numpy as np

from training.data.batches import seen_from_first
from training.data.lidar_drives import Reference, ReferencePoses, Relations, TruePoses
from training.scoring.metrics import absolute_error_m, off_by, trajectory_error, within
from training.scoring.relations import interpolated, relation_errors

Errors = dict[str, np.ndarray]
"""Errors by the metric's key, each ``(samples,)``: one a relation, or a single one of a whole trajectory."""

_FINEST = 1e-3  # m and rad


def lidar_errors(reference: Reference | None, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> Errors:
    """Errors of an estimate ``(n, 3)`` at increasing stamps ``(n,)``.

    - Relations: ``translation_m``, ``rotation_deg`` of each, and ``far_m``, ``far_deg`` of those that span over 30 s.
    - A mapper's poses: ``ate_m``, the root mean square distance of positions after the best rigid alignment (Sturm et
      al. 2012).
    - The truth: ``ate_m``, and aligned at the first pose alone ``position_rmse_m``, ``heading_rmse_deg``.

    Raises:
        ValueError: nothing is known of the drive, or the estimate says nothing about what is.
    """
    if reference is None:
        raise ValueError("nothing is known of where the robot was; expected a reference")
    # From an epoch's start a float loses microseconds: relations are given in such floats, all else from the first.
    if isinstance(reference, Relations):
        found = relation_errors(reference, stamps_ns * 1e-9, poses_xyyaw)
        return {
            "translation_m": found.translation_m,
            "rotation_deg": found.rotation_deg,
            "far_m": found.translation_m[found.far],
            "far_deg": found.rotation_deg[found.far],
        }
    estimate = _at(reference.stamps_ns, stamps_ns, poses_xyyaw)
    errors = {"ate_m": np.array([absolute_error_m(estimate, reference.poses_xyyaw)])}
    if isinstance(reference, ReferencePoses):
        return errors
    first = trajectory_error(estimate, reference.poses_xyyaw)
    return {
        **errors,
        "position_rmse_m": np.array([first.position_rmse_m]),
        "heading_rmse_deg": np.array([first.heading_rmse_deg]),
    }


def covariance_errors(truth: TruePoses, stamps_ns: np.ndarray, poses: np.ndarray, covariances: np.ndarray) -> Errors:
    """How well the covariances ``(n, 3, 3)`` of published poses ``(n, 3)`` tell their errors.

    Poses and truth are seen from the first scan. ``within_three_deviations`` is the share of the poses whose x, y and
    heading are each within three of their own deviations of the truth. ``negative_log_likelihood`` is the mean over the
    poses, in nats (m, m, rad): of two covariances that hold the truth, the smaller one has the lower number. Variances
    of a mm and a mrad are added.
    """
    start, true = truth.stamps_ns[0], seen_from_first(truth.poses_xyyaw)
    true_then = interpolated((truth.stamps_ns - start) * 1e-9, true, (stamps_ns - start) * 1e-9)
    off = off_by(poses, true_then)
    published = covariances + _FINEST**2 * np.eye(3)
    mahalanobis = np.einsum("ni,ni->n", off, np.linalg.solve(published, off[..., None])[..., 0])
    likelihood = -0.5 * (mahalanobis + np.linalg.slogdet(published).logabsdet + 3.0 * np.log(2.0 * np.pi))
    return {
        "within_three_deviations": np.array([within(poses, covariances, true_then)]),
        "negative_log_likelihood": np.array([-likelihood.mean()]),
    }


def _at(wanted_ns: np.ndarray, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> np.ndarray:
    start = wanted_ns[0]
    return interpolated((stamps_ns - start) * 1e-9, poses_xyyaw, (wanted_ns - start) * 1e-9)
