"""A loaded trajectory that goes on from another start: the robot is found in its map, and the map grows from there."""

from dataclasses import replace

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.map_localisation import LocalisedStep
from ngo_estimator.slam.map_origin import MapOrigin


class Joining:
    """Looks for a robot in the map of a loaded trajectory, which stays as it is until the robot is found.

    The frames before are for finding it alone: the trajectory goes on with the frame at which the pose is claimed.
    """

    def __init__(self, core: CorrectedTrajectory, origin: MapOrigin) -> None:
        """Join ``core``, which lies in ``map`` as ``origin`` says.

        Raises:
            ValueError: the trajectory shows no places.
        """
        self._core, self._origin = core, origin
        self._localisation = core.localisation(origin)
        self._localisation.take_time()

    def reset(self) -> None:
        """Forget where the robot may be."""
        self._localisation.reset()

    def set_pose(self, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> None:
        """Take the pose ``(3,)`` in ``map``, and its covariance ``(3, 3)``, from somebody who knows them."""
        self._localisation.set_pose(pose_xyyaw, covariance)

    def update(self, step: RelativeStep) -> LocalisedStep:
        """Take the next step; where it says where the robot is, the trajectory goes on from there.

        Raises:
            RejectedStep: it cannot be used, or is not later than the trajectory. Everything is then as before.
        """
        self._core.check_later(step)
        localised = self._localisation.update(step)
        found = localised.found
        if found.pose_xyyaw is None or found.covariance is None or not self._core.may_join(step):
            return localised
        own = self._origin.own(found.pose_xyyaw, found.covariance)
        return replace(localised, joined=self._core.join(step, *own))
