"""The two simulated worlds as training data: which mazes, which seeds, which driver."""

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from ngo_estimator.checkpoint import WORLD_IMAGES
from ngo_estimator.images import ImageFormat
from ngo_sim.maze2d import Maze2D, Maze2DConfig

# A maze is a function of its seed and size: these ranges never meet (tests/unit/training/test_worlds.py).
TEST_SEEDS = range(0, 1_000)
VALIDATION_SEEDS = range(1_000, 2_000)
DEMO_SEEDS = range(2_000, 3_000)
TRAIN_SEEDS = range(10_000, 2_000_000_000)
# The optimizer learns on odometry of mazes that the local network has not seen, as it will meet it later.
OPTIMIZER_TRAIN_SEEDS = range(2_000_000_000, 2**32)


@dataclass(frozen=True)
class World:
    """A simulated world.

    ``block_m`` is the corridor width, ``actions`` the number of discrete actions, ``episode_frames`` the length of the
    paper's trajectories, ``rows`` and ``extra_openings`` the ranges (both ends included) that training mazes are
    drawn from, ``heading_limit_rad`` how far two frames of one place may be turned against each other.
    """

    name: str
    image: ImageFormat
    driver: str
    block_m: float
    period_s: float
    episode_frames: int
    rows: tuple[int, int]
    extra_openings: tuple[int, int]
    place_radius_m: float
    heading_limit_rad: float
    actions: int = 3

    def make(self, rows: int | None = None, extra_openings: int | None = None) -> gymnasium.Env[Any, Any]:
        """An environment with mazes of this size, by default the simulator's own size."""
        changes = {} if rows is None else {"rows": rows, "cols": rows}
        if extra_openings is not None:
            changes["extra_openings"] = extra_openings
        if self.name == "maze2d":
            return Maze2D(Maze2DConfig(**changes))
        from ngo_sim.maze3d import Maze3D, Maze3DConfig  # loads ViZDoom, which the 2D world does without

        return Maze3D(Maze3DConfig(**changes))

    def make_random(self, rng: np.random.Generator) -> gymnasium.Env[Any, Any]:
        """An environment with mazes of a random size and number of openings."""
        rows = int(rng.integers(self.rows[0], self.rows[1] + 1))
        openings = int(rng.integers(self.extra_openings[0], self.extra_openings[1] + 1))
        return self.make(rows, openings)


WORLDS = {
    "maze2d": World(
        name="maze2d",
        image=WORLD_IMAGES["maze2d"],
        driver="corners",
        block_m=1.0,
        period_s=0.1,
        episode_frames=2000,
        rows=(5, 8),
        extra_openings=(0, 6),
        place_radius_m=0.5,
        heading_limit_rad=np.pi,
    ),
    "maze3d": World(
        name="maze3d",
        image=WORLD_IMAGES["maze3d"],
        driver="random_goals",
        block_m=3.0,
        period_s=2 / 35,
        episode_frames=1000,
        rows=(4, 6),
        extra_openings=(0, 3),
        place_radius_m=1.0,
        heading_limit_rad=np.radians(35.0),
    ),
}


def world_named(name: str) -> World:
    """The world called ``name``; raises ``ValueError`` naming those that exist."""
    if name not in WORLDS:
        raise ValueError(f"world is {name!r}; expected one of {', '.join(WORLDS)}")
    return WORLDS[name]
