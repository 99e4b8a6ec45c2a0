"""What measured relative poses are off, and what the steps between their poses explain of it, compiled.

Arrays of one graph; ``ngo.loop_gates`` has the same for tensors, where gradients are asked for.
"""

import math

import numpy as np
from numba import njit

from ngo_estimator.geometry.planar_motion import all_between, chained, wrap
from ngo_estimator.graph.block_cholesky import Array

__all__ = [
    "all_between",
    "chained",
    "loop_residuals",
    "odometry_variances",
    "predicted_covariances",
    "squared_and_log",
    "whitened_residuals",
]


@njit(cache=True, error_model="numpy")
def loop_residuals(nodes: Array, measured: Array, poses: Array) -> Array:
    """Measured less current relative poses ``(n, 3)`` of nodes ``(n, 2)``, positions along the axes of the map."""
    residuals = np.empty((len(nodes), 3))
    for k in range(len(nodes)):
        a, b = nodes[k, 0], nodes[k, 1]
        x, y, yaw = measured[k, 0], measured[k, 1], measured[k, 2]
        cos, sin = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        residuals[k, 0] = poses[a, 0] + cos * x - sin * y - poses[b, 0]
        residuals[k, 1] = poses[a, 1] + sin * x + cos * y - poses[b, 1]
        residuals[k, 2] = wrap(poses[a, 2] + yaw - poses[b, 2])
    return residuals


@njit(cache=True, error_model="numpy")
def odometry_variances(nodes: Array, poses: Array, step_variance: Array) -> Array:
    """Variances ``(n, 3)`` of the later nodes as seen from the earlier ones by the steps between neighbours alone.

    Args:
        nodes: the earlier and the later one ``(n, 2)``; poses: of all nodes ``(steps + 1, 3)``.
        step_variance: ``(steps, 3)``, along the axes of the earlier pose.
    """
    sums = np.zeros((len(poses), 7))
    for k in range(len(step_variance)):
        first, second, turn = step_variance[k, 0], step_variance[k, 1], step_variance[k, 2]
        x, y = poses[k + 1, 0], poses[k + 1, 1]
        along_x = math.cos(poses[k, 2]) ** 2
        in_x = along_x * first + (1.0 - along_x) * second
        terms = (in_x, first + second - in_x, turn, turn * x, turn * y, turn * x * x, turn * y * y)
        for c in range(7):
            sums[k + 1, c] = sums[k, c] + terms[c]
    variances = np.empty((len(nodes), 3))
    for k in range(len(nodes)):
        a, b = nodes[k, 0], nodes[k, 1]
        x, y, along = poses[b, 0], poses[b, 1], sums[b] - sums[a]
        turn = along[2]
        variances[k, 0] = max(along[0] + y * (y * turn - 2.0 * along[4]) + along[6], 0.0)
        variances[k, 1] = max(along[1] + x * (x * turn - 2.0 * along[3]) + along[5], 0.0)
        variances[k, 2] = max(turn, 0.0)
    return variances


@njit(cache=True, error_model="numpy")
def whitened_residuals(nodes: Array, measured: Array, root: Array, poses: Array) -> Array:
    """Measured less current relative poses ``(n, 3)``, along the first node, times ``root`` ``(n, 3, 3)``."""
    residuals = np.empty((len(nodes), 3))
    for k in range(len(nodes)):
        a, b = nodes[k, 0], nodes[k, 1]
        cos, sin = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        x, y = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        along, across = measured[k, 0] - cos * x - sin * y, measured[k, 1] + sin * x - cos * y
        turn = wrap(measured[k, 2] - poses[b, 2] + poses[a, 2])
        for r in range(3):
            residuals[k, r] = root[k, r, 0] * along + root[k, r, 1] * across + root[k, r, 2] * turn
    return residuals


@njit(cache=True, error_model="numpy")
def predicted_covariances(nodes: Array, root: Array, poses: Array, joint: Array) -> Array:
    """Covariances ``(n, 3, 3)`` of current relative poses times ``root``, from those ``(n, 6, 6)`` of both poses."""
    predicted = np.empty((len(nodes), 3, 3))
    plain, slopes, spread = np.zeros((3, 6)), np.empty((3, 6)), np.empty((3, 6))
    plain[2, 2], plain[2, 5] = -1.0, 1.0
    for k in range(len(nodes)):
        a, b = nodes[k, 0], nodes[k, 1]
        cos, sin = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        x, y = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        plain[0, 0], plain[0, 1], plain[0, 2], plain[0, 3], plain[0, 4] = -cos, -sin, cos * y - sin * x, cos, sin
        plain[1, 0], plain[1, 1], plain[1, 2], plain[1, 3], plain[1, 4] = sin, -cos, -cos * x - sin * y, -sin, cos
        for r in range(3):
            for c in range(6):
                slopes[r, c] = root[k, r, 0] * plain[0, c] + root[k, r, 1] * plain[1, c] + root[k, r, 2] * plain[2, c]
        for r in range(3):
            for c in range(6):
                total = 0.0
                for m in range(6):
                    total += slopes[r, m] * joint[k, m, c]
                spread[r, c] = total
        for r in range(3):
            for c in range(3):
                total = 0.0
                for m in range(6):
                    total += spread[r, m] * slopes[c, m]
                predicted[k, r, c] = total
    return predicted


@njit(cache=True, error_model="numpy")
def squared_and_log(residuals: Array, predicted: Array) -> tuple[Array, Array]:
    """Squared lengths ``(n,)`` of residuals ``(n, 3)`` in deviations, and the logs of their determinants.

    Their covariances are ``predicted`` ``(n, 3, 3)`` and the identity.
    """
    squared, logs = np.empty(len(residuals)), np.empty(len(residuals))
    for k in range(len(residuals)):
        p, r = predicted[k], residuals[k]
        l00 = math.sqrt(1.0 + p[0, 0])
        l10, l20 = p[1, 0] / l00, p[2, 0] / l00
        l11 = math.sqrt(1.0 + p[1, 1] - l10 * l10)
        l21 = (p[2, 1] - l20 * l10) / l11
        l22 = math.sqrt(1.0 + p[2, 2] - l20 * l20 - l21 * l21)
        u = r[0] / l00
        v = (r[1] - l10 * u) / l11
        w = (r[2] - l20 * u - l21 * v) / l22
        squared[k], logs[k] = u * u + v * v + w * w, 2.0 * math.log(l00 * l11 * l22)
    return squared, logs
