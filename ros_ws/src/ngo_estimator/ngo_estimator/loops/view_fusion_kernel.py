"""The robust fusion of the views of pairs, compiled; ``pair_measurement.fuse_views`` says what it is."""

import math

import numpy as np
from numba import njit

from ngo_estimator.geometry.planar_motion import wrap
from ngo_estimator.graph.block_cholesky import Array


@njit(cache=True, error_model="numpy")
def fuse(measured: Array, log_scale: Array, reweightings: int, least_spread: float) -> tuple[Array, Array, Array]:
    """Poses ``(n, 3)``, the logarithm of their scales ``(n, 2)`` and of how far the views disagree ``(n, 2)``.

    Args:
        measured: ``(views, n, 3)``; log_scale: ``(views, n, 2)``.
    """
    views, count = measured.shape[:2]
    pose, scale, spread = np.empty((count, 3)), np.empty((count, 2)), np.empty((count, 2))
    precision, weight, squares = np.empty((views, 2)), np.empty((views, 2)), np.empty((views, 2))
    error, mean = np.empty((views, 3)), np.empty(3)
    for k in range(count):
        for v in range(views):
            for c in range(2):
                error[v, c] = measured[v, k, c] - measured[0, k, c]
                precision[v, c] = weight[v, c] = math.exp(-2.0 * log_scale[v, k, c])
            error[v, 2] = wrap(measured[v, k, 2] - measured[0, k, 2])
        for _ in range(reweightings + 1):
            for c in range(3):
                of = c // 2
                mean[c] = (weight[:, of] * error[:, c]).sum() / weight[:, of].sum()
            for v in range(views):
                squares[v, 0] = (error[v, 0] - mean[0]) ** 2 + (error[v, 1] - mean[1]) ** 2
                squares[v, 1] = (error[v, 2] - mean[2]) ** 2
                for c in range(2):
                    weight[v, c] = precision[v, c] / (1.0 + 0.25 * precision[v, c] * squares[v, c])
        pose[k, 0], pose[k, 1] = measured[0, k, 0] + mean[0], measured[0, k, 1] + mean[1]
        pose[k, 2] = wrap(measured[0, k, 2] + mean[2])
        for c in range(2):
            total = weight[:, c].sum()
            scale[k, c] = -0.5 * math.log(total)
            spread[k, c] = math.log(max(math.sqrt((weight[:, c] * squares[:, c]).sum() / total), least_spread))
    return pose, scale, spread
