"""A trajectory, where it lies in ``map``, and the correction that the robot sees: saved and loaded together."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ngo_estimator.data.state_arrays import Arrays, part, restore, state_of, under
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.joining import Joining
from ngo_estimator.slam.map_localisation import MapLocalisation
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.saved_state import read_state, write_state
from ngo_estimator.slam.tf_smoothing import SmoothedCorrection


@dataclass(frozen=True)
class Session:
    """What a robot goes on with after a break. ``world`` names the weights."""

    world: str
    core: CorrectedTrajectory
    origin: MapOrigin
    smoothing: SmoothedCorrection

    def state(self) -> Arrays:
        """Copies of all of it; raises ``StateError`` before the first step."""
        return {
            **self.core.state(),
            **under("origin", state_of(self.origin)),
            **under("smoothing", state_of(self.smoothing)),
        }

    def write(self, folder: Path, arrays: Arrays) -> None:
        """Write a ``state()``, all at once or not at all; raises ``StateError``."""
        write_state(folder, {"world": self.world, **self.core.identity}, arrays)

    def loaded(self, folder: Path) -> "Session":
        """Another session with these networks and settings, in the state in ``folder``; this one stays as it is.

        Raises:
            StateError: of one line; see ``read_state`` and ``CorrectedTrajectory.restored``.
        """
        arrays = read_state(folder, {"world": self.world, **self.core.identity})
        return Session(
            self.world,
            self.core.restored(arrays),
            restore(MapOrigin(np.zeros(3)), part(arrays, "origin")),
            self.smoothing.restored(part(arrays, "smoothing")),
        )

    def localisation(self) -> MapLocalisation:
        """Localisation in the map as it is; raises ``ValueError`` where it shows no places."""
        return self.core.localisation(self.origin)

    def joining(self) -> Joining:
        """The search for a robot with which the session goes on from another start; raises as ``localisation``."""
        return Joining(self.core, self.origin)
