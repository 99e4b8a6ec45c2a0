"""Which trajectories are driven for a feature store: their mazes, seeds and driver."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from training.data.episodes import episodes_in
from training.data.worlds import MazeSize, World

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode


class Drives(NamedTuple):
    """Trajectories: the seed of each one's maze and that of its episode, the mazes' size, and the driver's name.

    ``steps`` of each; None: the world's number.
    """

    mazes: list[int]
    seeds: list[int]
    size: MazeSize
    driver: str
    steps: int | None = None

    def episodes(self, world: World, group: slice) -> Iterator[Episode]:
        """Episodes of a group of mazes of one size."""
        frames = (self.steps or world.episode_frames) + 1
        return episodes_in(world, self.mazes[group], self.seeds[group], frames, self.size, self.driver)


def drives_of_table(world: World, table: str, split: str, count: int) -> Drives:
    """The first ``count`` trajectories of a table of results."""
    mazes, seeds = (list(of(table, split)[:count]) for of in (world.table_mazes, world.table_seeds))
    return Drives(mazes, seeds, world.tables[table].size, world.table_driver(table))
