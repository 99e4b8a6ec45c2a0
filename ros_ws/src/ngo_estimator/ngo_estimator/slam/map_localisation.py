"""A log of steps and a localiser: the robot's pose in a saved map, step by step (no ROS here)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.planar_covariance import bounded
from ngo_estimator.geometry.se2 import compose, inverse
from ngo_estimator.slam.localisation import Localisation, Localiser
from ngo_estimator.slam.step_log import StepLog
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate


@dataclass(frozen=True)
class LocalisedStep:
    """What a step showed.

    ``found`` is what is known of the pose after it, ``map_from_odom_xyyaw`` (3,) goes with a pose that is known, None
    otherwise. ``restarted``: the odometry began anew, ``gap``: steps before this one were lost. ``joined`` is what it
    changed in a trajectory that goes on from here, None where the map stays as it is.
    """

    found: Localisation
    map_from_odom_xyyaw: np.ndarray | None
    restarted: bool
    gap: bool
    joined: TrajectoryUpdate | None = None


class MapLocalisation:
    """Takes the steps of a robot in a map that stays as it is.

    An odometry that begins anew says nothing about where the robot went meanwhile: its pose is then not known.
    """

    def __init__(self, localiser: Localiser, checked: Callable[[RelativeStep], RelativeStep]) -> None:
        self._localiser, self._checked = localiser, checked
        self._log = StepLog()

    def take_time(self) -> None:
        """See ``Localiser``."""
        self._localiser.take_time()

    def reset(self) -> None:
        """Forget the pose."""
        self._log.reset()
        self._localiser.reset()

    def set_pose(self, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> None:
        """Take the pose ``(3,)`` in the map, and its covariance ``(3, 3)``, from somebody who knows them."""
        self._localiser.set_pose(pose_xyyaw, bounded(covariance))

    def update(self, step: RelativeStep) -> LocalisedStep:
        """Take the next step; raises ``RejectedStep`` for one that cannot be used. Everything is then as before."""
        step = self._checked(step)
        restarted = self._log.is_restart(step)
        if restarted:
            self.reset()
        taken = self._log.take(step)
        found = self._localiser.update(step, taken.relative_xyyaw.astype(np.float64), bounded(taken.covariance))
        map_from_odom = None
        if found.pose_xyyaw is not None:
            map_from_odom = compose(found.pose_xyyaw, inverse(step.tf_odom_xyyaw))
        return LocalisedStep(found, map_from_odom, restarted, taken is not step)
