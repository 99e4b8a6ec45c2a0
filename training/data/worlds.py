"""The simulated worlds as training data: their mazes, seeds and drivers.

The simulators are imported where an environment is made: training on recordings works without them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ngo_estimator.checkpoint import WORLD_IMAGES
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from training.data.data_source import OTHER_TRAIN_STORE, TRAIN_STORE, Domain

if TYPE_CHECKING:
    import gymnasium

WorldName = Literal["maze2d", "maze3d", "doom"]

# A maze is a function of its seed and size: these ranges never meet (tests/unit/training/data/test_worlds.py).
TEST_SEEDS = range(0, 1_000)
VALIDATION_SEEDS = range(1_000, 2_000)
DEMO_SEEDS = range(2_000, 3_000)
TRAIN_SEEDS = range(10_000, 2_000_000_000)
# The optimizer learns on odometry of mazes that the local network has not seen, as it will meet it later.
OPTIMIZER_TRAIN_SEEDS = range(2_000_000_000, 2**32)

_SPLIT_SEEDS = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}
_TABLE_SEEDS = 200
_STRETCHES = 2  # of so many seeds in the second half of a split


@dataclass(frozen=True)
class MazeSize:
    """The mazes of a table of results; what is None is drawn as in training. Aliased ones repeat one module."""

    rows: int | None = None
    extra_openings: int | None = None
    aliased: bool = False


DRAWN = MazeSize()


@dataclass(frozen=True)
class Table:
    """Which trajectories a table of results is about.

    ``stretch`` counts the stretches of 200 seeds in the split: tables of one stretch have the same mazes and starts.
    With ``seen`` the mazes and their looks are those that the local network was trained in, and only starts, noise and
    what the driver does are of the split. ``driver`` None is the world's.
    """

    size: MazeSize = DRAWN
    stretch: int = 0
    seen: bool = False
    driver: str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.stretch < _STRETCHES:
            raise ValueError(f"stretch is {self.stretch}; expected 0 to {_STRETCHES - 1}")
        if self.seen and self.size != DRAWN:
            raise ValueError(f"size is {self.size} of mazes that were seen; expected none, as they were drawn")


@dataclass(frozen=True, kw_only=True)
class World(Domain):
    """A simulated world. No driver here drives backwards."""

    driver: str  # Name of the driver wherever no other is named; smoother and optimizer learn from its trajectories.
    training_drivers: tuple[str, ...] = ()
    """Drivers that take turns in the streams, from which all other networks learn; none: ``driver``."""
    optimizer_driver: str | None = None
    """Driver of one more trajectory for every five of ``driver``, for the optimizer alone; None: nobody."""
    episode_frames: int  # Length of the paper's trajectories.
    rows: tuple[int, int]  # Range of the rows of training mazes, both ends included.
    extra_openings: tuple[int, int]  # Range of the extra openings of training mazes, both ends included.
    tables: dict[str, Table]  # The tables of results.
    table_trajectories: int = 64  # Trajectories of a table.
    prefixes: tuple[int, ...] = (250, 500, 750, 1000)  # Numbers of steps after which a table gives errors.

    @property
    def stream_drivers(self) -> tuple[str, ...]:
        """The names of the drivers that take turns in streams of training data."""
        return self.training_drivers or (self.driver,)

    @property
    def stream_settings(self) -> dict[str, Any]:
        """Settings of the world that a training on a stream depends on, for its record."""
        return {"training_drivers": list(self.stream_drivers)}

    @property
    def unseen_tables(self) -> tuple[str, ...]:
        """The tables with the world's driver in mazes that nothing was trained in: designs are chosen on these."""
        return tuple(name for name, table in self.tables.items() if not table.seen and table.driver is None)

    @property
    def optimizer_stores(self) -> tuple[str, ...]:
        return (TRAIN_STORE,) if self.optimizer_driver is None else (TRAIN_STORE, OTHER_TRAIN_STORE)

    @property
    def validation_stores(self) -> tuple[str, ...]:
        return tuple(f"validation_{table}" for table in self.unseen_tables)

    def make(
        self, rows: int | None = None, extra_openings: int | None = None, aliased: bool = False, **more: Any
    ) -> gymnasium.Env[Any, Any]:
        """An environment with mazes of this size, by default the simulator's own; ``more`` goes to the 3D one."""
        changes: dict[str, Any] = {"aliased": aliased}
        if rows is not None:
            changes.update(rows=rows, cols=rows)
        if extra_openings is not None:
            changes["extra_openings"] = extra_openings
        if self.name == "maze2d":
            from ngo_sim.maze2d import Maze2D, Maze2DConfig

            return Maze2D(Maze2DConfig(**changes))
        from ngo_sim.maze3d import Maze3D, Maze3DConfig  # loads ViZDoom, which the 2D world does without

        return Maze3D(Maze3DConfig(**changes), **more)

    def table_seeds(self, table: str, split: str) -> range:
        """Seeds of a table's episodes in the ``validation`` or ``test`` split."""
        if table not in self.tables or split not in _SPLIT_SEEDS:
            raise ValueError(
                f"table, split are {table!r}, {split!r}; expected one of {', '.join(self.tables)} and one of "
                f"{', '.join(_SPLIT_SEEDS)}"
            )
        seeds = _SPLIT_SEEDS[split]
        first = len(seeds) // 2 + _TABLE_SEEDS * self.tables[table].stretch
        return seeds[first : first + _TABLE_SEEDS]

    def table_mazes(self, table: str, split: str) -> range:
        """Maze seeds of a table, one for each of its ``table_seeds`` and the same where its mazes were not seen.

        Mazes that were seen are the first ones of the local network's first epoch, other ones for each split.
        """
        seeds = self.table_seeds(table, split)
        if not self.tables[table].seen:
            return seeds
        first = len(seeds) * list(_SPLIT_SEEDS).index(split)
        return TRAIN_SEEDS[first : first + len(seeds)]

    def split_end(self, split: str) -> range:
        """The last 100 seeds of the ``validation`` or ``test`` split, which no table of trajectories takes."""
        return _SPLIT_SEEDS[split][-_TABLE_SEEDS // 2 :]

    def table_driver(self, table: str) -> str:
        """The name of the driver of a table's trajectories."""
        return self.tables[table].driver or self.driver

    def make_random(self, rng: np.random.Generator, size: MazeSize = DRAWN, **more: Any) -> gymnasium.Env[Any, Any]:
        """An environment with mazes of ``size``; a random size and number of openings where that has None."""
        rows = int(rng.integers(self.rows[0], self.rows[1] + 1))
        openings = int(rng.integers(self.extra_openings[0], self.extra_openings[1] + 1))
        return self.make(
            rows if size.rows is None else size.rows,
            openings if size.extra_openings is None else size.extra_openings,
            size.aliased,
            **more,
        )


WORLDS = {
    "maze2d": World(
        name="maze2d",
        image=WORLD_IMAGES["maze2d"],
        driver="corners",
        block_m=1.0,
        period_s=0.1,
        episode_frames=2000,
        rows=(5, 8),
        extra_openings=(0, 8),
        place_radius_m=0.5,
        heading_limit_rad=np.pi,
        loop_views=5,
        # Ranges are exact but for their storage as float16.
        registration=RegistrationConfig(rays=241, field_of_view_deg=300.0, noise_m=0.001),
        tables={"perfect": Table(MazeSize(7, 0)), "cycles": Table(MazeSize(7, 8), stretch=1)},
        table_trajectories=100,
        prefixes=(250, 500, 1000, 1500, 2000),
    ),
    "maze3d": World(
        name="maze3d",
        image=WORLD_IMAGES["maze3d"],
        driver="random_goals",
        # The learned driver grazes walls, as others may: networks that never saw it are lost there.
        training_drivers=(*("random_goals",) * 5, "learned"),
        # From the planner's trajectories alone it learns to trust odometry where the learned driver's fails.
        optimizer_driver="learned",
        block_m=3.0,
        period_s=2 / 35,
        episode_frames=1000,
        rows=(4, 6),
        extra_openings=(0, 3),
        place_radius_m=1.0,
        heading_limit_rad=np.radians(35.0),
        # Ranges that a network sees in pictures: good enough for loops, not for steps.
        registration=RegistrationConfig(
            rays=81, field_of_view_deg=106.0, noise_m=0.01, noise_share=0.03, last_tolerance=2.0, odometry=False
        ),
        # Four frames on, at 0.24 m a frame, most pairs are out of the range that the pair head knows.
        loop_views=1,
        # Places look alike to few frames; more share walls, also with frames that face them.
        max_loops=128,
        overlaps=256,
        # What moves the robot sideways shows in the steps around a turn (docs/results.md).
        smoothing=True,
        optimizer_epochs=20,
        loss_scale=0.3,
        # The robot's turn rate falls by a quarter a step: after twelve 3 % of it is left.
        action_history=12,
        # What actions do not tell has momentum too: where errors of steps alone count, they add up (docs/results.md).
        error_windows=(1, 4, 16),
        tables={
            "seen": Table(stretch=1, seen=True),
            "unseen": Table(),
            # The same mazes and starts, driven by the network that was trained to travel far.
            "seen_policy": Table(stretch=1, seen=True, driver="learned"),
            "unseen_policy": Table(driver="learned"),
        },
    ),
}
# Levels of rooms, maps of freedoom and mazes, together (training/data/doom_drives.py).
WORLDS["doom"] = dataclasses.replace(
    WORLDS["maze3d"],
    name="doom",
    driver="explorer",
    training_drivers=(),
    optimizer_driver=None,
    # Walls have any height there, and a picture does not tell how far they are.
    registration=None,
    overlaps=0,
    smoothing=False,
    # Along a wall that slows the robot errors last: sums over half a drive are further off than 100 steps tell.
    deviation_steps=512,
    tables={"unseen": Table()},
)


def world_named(name: str) -> World:
    """The world called ``name``; raises ``ValueError`` naming those that exist."""
    if name not in WORLDS:
        raise ValueError(f"world is {name!r}; expected one of {', '.join(WORLDS)}")
    return WORLDS[name]
