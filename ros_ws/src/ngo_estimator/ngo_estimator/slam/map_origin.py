"""Where a trajectory that begins at the origin lies in ``map`` (no ROS here)."""

from dataclasses import dataclass, field

import numpy as np

from ngo_estimator.geometry.planar_motion import turned_covariance
from ngo_estimator.geometry.se2 import compose, inverse


@dataclass(frozen=True)
class MapOrigin:
    """The rigid motion from a trajectory's own frame, whose origin is its first pose, to ``map``.

    ``map_from_start_xyyaw`` (3,); ``covariance`` (3, 3) is that of the pose ``given_xyyaw`` (3,) in ``map`` from which
    the motion was found (m, m, rad).
    """

    map_from_start_xyyaw: np.ndarray
    given_xyyaw: np.ndarray = field(default_factory=lambda: np.zeros(3))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def of_first_pose(cls, pose_xyyaw: np.ndarray) -> "MapOrigin":
        """The first pose of the trajectory is ``pose_xyyaw`` (3,) in ``map``."""
        return cls.of_pose(np.zeros(3), pose_xyyaw)

    @classmethod
    def of_pose(
        cls, start_from_base_xyyaw: np.ndarray, map_from_base_xyyaw: np.ndarray, covariance: np.ndarray | None = None
    ) -> "MapOrigin":
        """A pose of the trajectory, ``start_from_base_xyyaw``, is ``map_from_base_xyyaw`` in ``map``."""
        map_from_start = compose(map_from_base_xyyaw, inverse(start_from_base_xyyaw))
        return cls(map_from_start, map_from_base_xyyaw, np.zeros((3, 3)) if covariance is None else covariance)

    def poses(self, poses_xyyaw: np.ndarray) -> np.ndarray:
        """Poses ``(..., 3)`` of the trajectory, in ``map``."""
        if not self.map_from_start_xyyaw.any():
            return poses_xyyaw
        return compose(self.map_from_start_xyyaw, poses_xyyaw)

    def own(self, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A pose ``(3,)`` in ``map``, and its covariance ``(3, 3)`` along its axes, as the trajectory has both."""
        own = compose(inverse(self.map_from_start_xyyaw), pose_xyyaw)
        return own, turned_covariance(-float(self.map_from_start_xyyaw[2]), covariance)

    def covariance_of(self, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Covariance ``(3, 3)`` in ``map`` of a pose ``(3,)`` in ``map``, with that in the trajectory's own frame.

        To it comes that of the origin, whose uncertain heading turns the pose about the one that was given.
        """
        yaw = self.map_from_start_xyyaw[2]
        cos, sin = np.cos(yaw), np.sin(yaw)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        x, y = pose_xyyaw[:2] - self.given_xyyaw[:2]
        lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        return np.asarray(rotation @ covariance @ rotation.T + lever @ self.covariance @ lever.T)
