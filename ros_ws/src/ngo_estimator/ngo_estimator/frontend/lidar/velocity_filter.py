"""The robot's velocity by the poses that matches found, and how its errors go into the next pose.

Where walls leave a direction open, as a corridor does, the velocity carries the pose along it, and what a later match
corrects there is no motion: pose and velocity have one covariance (a Kalman filter).
"""

import numpy as np
from numba import njit

from ngo_estimator.geometry.planar_motion import Array, wrap

_R, _V = slice(0, 3), slice(3, 6)


class VelocityFilter:
    """A Kalman filter of the pose since the last key scan, along the odometry's axes, and of the ``velocity`` ``(3,)``
    along the robot's (m, m, rad in a usual period); ``joint`` ``(6, 6)`` is the covariance of both."""

    def __init__(self) -> None:
        self.velocity = np.zeros(3)
        self.joint = np.zeros((6, 6))
        self._drift = np.zeros((3, 6))  # errors of the last key scan's pose, against both

    def predicted(self, yaw: float, step: Array, periods: float, deviations: Array) -> tuple[Array, Array]:
        """The joint covariance after a ``step`` ``(3,)`` of so many periods from a pose of heading ``yaw``, which
        changes of the velocity move by ``deviations`` ``(2,)`` (m, rad); and what it moves ``(6, 6)``."""
        return _predicted(self.joint, yaw, step, periods, deviations)

    def correct(self, foretold: tuple[Array, Array], change: Array, covariance: Array) -> None:
        """The pose that was predicted became another by ``change`` ``(3,)``, with its ``covariance``."""
        joint, moves = foretold
        self._drift = self._drift @ moves.T
        self.velocity, self.joint, self._drift = _corrected(self.velocity, joint, self._drift, change, covariance)

    def shared(self) -> Array:
        """What ``(3, 3)`` the covariance of the pose lacks in a sum of independent steps: errors of the velocity go
        from key scan to key scan."""
        twice = self._drift[:, _R] + self._drift[:, _R].T
        values, vectors = np.linalg.eigh(twice)
        result: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
        return result

    def begin(self, velocity: Array, variance: Array, covariance: Array) -> None:
        """The ``velocity`` ``(3,)`` has a covariance ``variance`` and the pose one ``covariance``, both ``(3, 3)``."""
        self.velocity, self.joint, self._drift = velocity, np.zeros((6, 6)), np.zeros((3, 6))
        self.joint[_R, _R], self.joint[_V, _V] = covariance, variance

    def begin_at_key(self) -> None:
        """The newest pose is that of a key scan: the next ones count from it."""
        drift = self._drift[:, _V] + self.joint[_R, _V]
        self._drift = np.zeros((3, 6))
        self._drift[:, _V] = drift
        self.joint[_R, :] = self.joint[:, _R] = 0.0


@njit(cache=True)
def _predicted(joint: Array, yaw: float, step: Array, periods: float, deviations: Array) -> tuple[Array, Array]:
    cos, sin = np.cos(yaw), np.sin(yaw)
    half_cos, half_sin = np.cos(yaw + 0.5 * step[2]), np.sin(yaw + 0.5 * step[2])
    moves = np.eye(6)
    moves[0, 2], moves[1, 2] = -(sin * step[0] + cos * step[1]), cos * step[0] - sin * step[1]
    moves[0, 3], moves[0, 4] = periods * half_cos, -periods * half_sin
    moves[1, 3], moves[1, 4] = periods * half_sin, periods * half_cos
    moves[2, 5] = periods
    changed = joint.copy()
    for k in range(3):
        changed[3 + k, 3 + k] += (deviations[k // 2] / periods) ** 2
    return moves @ changed @ moves.T, moves


@njit(cache=True)
def _corrected(
    velocity: Array, joint: Array, drift: Array, change: Array, covariance: Array
) -> tuple[Array, Array, Array]:  # fmt: skip
    predicted = np.ascontiguousarray(joint[:3, :3])
    gain = np.linalg.solve(predicted + 1e-12 * np.eye(3), np.ascontiguousarray(joint[:3, :])).T.copy()
    change = change.copy()
    change[2] = wrap(change[2])
    after = joint - gain @ (predicted - covariance) @ gain.T
    known = np.linalg.solve(predicted + 1e-12 * np.eye(3), predicted - covariance)
    drift = drift - np.ascontiguousarray(drift[:, :3]) @ known @ gain.T
    return velocity + np.ascontiguousarray(gain[3:]) @ change, 0.5 * (after + after.T), drift
