"""The robot's velocity where no wheels tell it, and how errors of it go into poses.

Not in the paper. Where walls leave a direction open, as a corridor does, the velocity carries the pose along it. Its
error lasts from scan to scan and from key scan to key scan. Pose and velocity therefore have one covariance. A graph
takes its steps as independent: what a step shares with those before it is added to its own covariance.
"""

import numpy as np
from numba import njit

from ngo_estimator.frontend.lidar.motion_model import NextVelocity
from ngo_estimator.geometry.planar_motion import Array

_R, _V = slice(0, 3), slice(3, 6)


class ConstantVelocity:
    """A Kalman filter of the pose since the last key scan, along the odometry's axes, and of the ``velocity`` ``(3,)``
    along the robot's (m/s, m/s, rad/s).

    ``largest`` ``(3,)`` is the deviation of a velocity that nothing measures.
    """

    def __init__(self, largest: Array) -> None:
        self.velocity = np.zeros(3)
        self.largest = largest
        self._joint = np.zeros((6, 6))  # of pose and velocity
        self._drift = np.zeros((3, 6))  # errors of the last key scan's pose, against both
        self._predicted = np.zeros((3, 3))

    def predict(
        self,
        yaw: float,
        elapsed: float,
        pose_noise: Array,
        velocity_noise: Array,
        following: NextVelocity | None = None,
    ) -> Array:
        """Covariance ``(3, 3)`` of the next pose, ``elapsed`` seconds after one of heading ``yaw``.

        The velocity between both changes by deviations ``velocity_noise`` ``(3,)`` at once. ``pose_noise`` ``(3,)`` are
        those of motion that is none of the velocity. Where a model knows the ``following`` velocity, it replaces the
        constant one, and both deviations count.
        """
        cos, sin = np.cos(yaw), np.sin(yaw)
        # An error of the velocity is forgotten as new ones come, so that it stays below the largest.
        kept = np.sqrt(np.clip(1.0 - (velocity_noise / self.largest) ** 2, 0.0, 1.0))
        changes, moves = np.eye(6), np.eye(6)
        changes[_V, _V] = np.diag(kept)
        moves[_R, _V] = elapsed * np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
        noise = np.diag(np.concatenate((np.zeros(3), velocity_noise**2)))
        if following is not None:
            self.velocity = following.mean
            changes[_V, _V] = following.by_velocity @ changes[_V, _V]
            noise[_V, _V] += following.covariance
        self._joint = moves @ (changes @ self._joint @ changes.T + noise) @ moves.T
        self._joint[_R, _R] += np.diag(pose_noise**2)
        self._drift = self._drift @ changes.T @ moves.T
        self._predicted = self._joint[_R, _R].copy()
        return self._predicted

    def update(self, change: Array, covariance: Array) -> None:
        """The predicted pose became another by ``change`` ``(3,)``, with a covariance ``(3, 3)``."""
        joint, predicted = self._joint, self._predicted
        gain = np.linalg.solve(predicted, joint[_R, :]).T  # (6, 3): what the pose tells of both
        self.velocity = self.velocity + gain[_V] @ change
        drift = self._drift[:, _R].copy()
        known = np.linalg.solve(predicted, predicted - covariance)
        self._drift = self._drift - drift @ known @ gain.T
        self._joint = joint - gain @ (predicted - covariance) @ gain.T

    def forget(self) -> None:
        """Nothing is known of the velocity any more, but that it is small."""
        self.velocity = np.zeros(3)
        self._joint[_V, :] = self._joint[:, _V] = 0.0
        self._drift[:, _V] = 0.0

    def begin(self, velocity: Array, covariance: Array) -> None:
        """The ``velocity`` ``(3,)`` has this covariance ``(3, 3)``, whatever was known before."""
        self.velocity = velocity
        self._joint, self._drift = np.zeros((6, 6)), np.zeros((3, 6))
        self._joint[_V, _V] = covariance

    def measure(self, velocity: Array, covariance: Array, noise: Array) -> None:
        """Another source measured a ``velocity`` ``(3,)``, after changes of the deviations ``noise`` ``(3,)``."""
        self.velocity, self._joint = _measured(self._joint, self.velocity, velocity, covariance, noise)
        self._drift = np.zeros((3, 6))

    def shared(self) -> Array:
        """What ``(3, 3)`` the covariance of the pose lacks in a sum of independent steps."""
        shared: Array = _shared(self._drift)
        return shared

    def begin_at_key(self) -> None:
        """The newest pose is that of a key scan: the next ones count from it."""
        drift = self._drift[:, _V] + self._joint[_R, _V]
        self._drift = np.zeros((3, 6))
        self._drift[:, _V] = drift
        self._joint[_R, :] = self._joint[:, _R] = 0.0


@njit(cache=True)
def _measured(joint: Array, velocity: Array, measured: Array, covariance: Array, noise: Array) -> tuple[Array, Array]:
    """Velocity ``(3,)`` and joint covariance ``(6, 6)`` after ``measure``."""
    before = joint[3:, 3:] + np.diag(noise**2)
    gain = np.ascontiguousarray(np.linalg.solve((before + covariance).T, before.T)).T
    after = np.zeros((6, 6))
    after[3:, 3:] = (np.eye(3) - gain) @ before
    return velocity + gain @ (measured - velocity), after


@njit(cache=True)
def _shared(drift: Array) -> Array:
    """The positive part ``(3, 3)`` of the drift ``(3, 6)`` of poses, twice."""
    twice = drift[:, :3] + drift[:, :3].T
    values, vectors = np.linalg.eigh(twice)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T
