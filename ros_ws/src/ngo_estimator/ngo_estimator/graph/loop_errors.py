"""What measured relative poses are off, and what the steps between their poses explain of it, compiled.

Arrays of one graph; ``ngo.loop_gates`` has the same for tensors, where gradients are asked for.
"""

import math

import numpy as np
from numba import njit

from ngo_estimator.geometry.planar_motion import all_between, chained, wrap
from ngo_estimator.graph.block_cholesky import Array

__all__ = ["all_between", "chained", "loop_residuals", "odometry_variances"]


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
