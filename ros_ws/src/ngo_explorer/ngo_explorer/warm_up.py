"""Compiles all that a decision needs: the first time it takes a minute, later a second."""

import numpy as np

from ngo_explorer.exploration import Exploration
from ngo_explorer.path_follower import PathFollower
from ngo_explorer.pilot import Pilot
from ngo_explorer.settings import DriveConfig, ExplorerConfig


def warm_up() -> None:
    """Explore a corridor with an unknown place at each end, for a few steps."""
    values = np.full((30, 200), 100, np.int8)
    values[5:25, 20:180] = 0
    values[5:25, :20] = values[5:25, 180:] = -1
    exploration = Exploration(ExplorerConfig())
    exploration.known.update(values, 0.1, np.zeros(2))
    follower = PathFollower(DriveConfig(), exploration.config)
    pilot, robot = Pilot(exploration, follower, 1.0, None), np.array((10.0, 1.5, 0.0))
    for step in range(3):
        pilot.step(robot, 3.0 * step)
        follower.step(exploration.known, robot, 3.0 * step)
