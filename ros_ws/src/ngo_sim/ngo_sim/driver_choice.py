"""Drivers by name."""

from __future__ import annotations

import numpy as np

from ngo_sim.distance_driver import DistanceDriver
from ngo_sim.drivers import Driver, PathDriver, RandomDriver
from ngo_sim.explorer import ExploringDriver
from ngo_sim.learned_driver import LearnedDriver
from ngo_sim.mazes import Maze

_GOALS = {"corners": "corners", "random_goals": "random"}
PLANNERS = (*_GOALS, "distance")  # Drivers that need a plan of the maze.

DRIVER_NAMES = (*PLANNERS, "learned", "explorer", "random")  # What make_driver knows.


def driver_generator(seed: int) -> np.random.Generator:
    """The random generator of the driver in the episode of this seed, independent of those of the world."""
    return np.random.default_rng((seed, 3))


def make_driver(name: str, maze: Maze | None, rng: np.random.Generator) -> Driver:
    """The driver called name; maze is None where there is no plan, as of a Doom map.

    "corners" and "random_goals" follow paths, "distance" drives for distance, "learned" looks at the pictures of the 3D
    world, "explorer" finds its way by bumping, "random" acts at random. Raises ValueError for another name, or where a
    plan is needed and missing.
    """
    if name in PLANNERS:
        if maze is None:
            others = ", ".join(one for one in DRIVER_NAMES if one not in PLANNERS)
            raise ValueError(f"driver is {name!r}, which needs a maze's plan; on a Doom map it must be one of {others}")
        return DistanceDriver(maze, rng) if name == "distance" else PathDriver(maze, rng, goals=_GOALS[name])
    if name == "learned":
        return LearnedDriver(rng)
    if name == "explorer":
        return ExploringDriver(rng)
    if name == "random":
        return RandomDriver(rng)
    raise ValueError(f"driver is {name!r}; it must be one of {', '.join(DRIVER_NAMES)}")
