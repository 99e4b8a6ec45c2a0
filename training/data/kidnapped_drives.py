"""Two drives in each maze: one makes the map, the other is where robots start that do not know their pose."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ngo_estimator.checkpoint import load_local, load_place
from training.data.drive_plan import Drives
from training.data.feature_store import STORED, begin_store, check_count, fill, open_store
from training.data.features import features_of
from training.data.worlds import DRAWN, MazeSize, World

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

Split = Literal["validation", "test"]
Features = dict[str, np.ndarray]

STEPS = 2000  # Steps of each drive.

_ALIASED = MazeSize(rows=6, extra_openings=0, aliased=True)
_ALIASED_FIRST, _SECOND_FIRST = 25, 50  # among the seeds: of aliased mazes, and of the second drives
_MAP_DRIVER = "random_goals"
_SECOND_DRIVER = "corners"


def planned_drives(world: World, split: Split, aliased: bool, count: int) -> dict[str, Drives]:
    """The drives ``map`` and ``second`` in ``count`` mazes, which no other table has; with other starts and drivers."""
    if not 1 <= count <= _ALIASED_FIRST:
        raise ValueError(f"mazes are {count}; expected 1 to {_ALIASED_FIRST}")
    first, seeds = aliased * _ALIASED_FIRST, world.split_end(split)
    mazes, others = list(seeds[first : first + count]), list(seeds[_SECOND_FIRST + first :][:count])
    size = _ALIASED if aliased else DRAWN
    return {
        "map": Drives(mazes, mazes, size, _MAP_DRIVER, STEPS),
        "second": Drives(mazes, others, size, _SECOND_DRIVER, STEPS),
    }


def kidnapped_drives(
    world: World, split: Split, aliased: bool, count: int, weights: Path, folder: Path
) -> dict[str, Features]:
    """Features of the drives ``map`` and ``second`` ``(mazes, steps, ...)``; what ``folder`` lacks is made.

    ``poses`` ``(mazes, steps + 1, 3)`` are the true ones of all frames in the maze's frame.
    """
    local, local_description = load_local(weights / world.name, world.name)
    place, place_description = load_place(weights / world.name, world.name)

    def features(episode: Episode) -> Features:
        found = features_of(world, episode, weights / world.name, (local, place))
        return {**found, "poses": episode.poses_xyyaw}

    stores: dict[str, Features] = {}
    for name, drives in planned_drives(world, split, aliased, count).items():
        store = folder / world.name / "relocalisation" / f"{split}_{'aliased_' * aliased}{name}"
        check_count(store, count)
        begin_store(store, local_description, place_description)
        fill(store, world, drives, (0, 1), features)
        stores[name] = open_store(store, (*STORED, "poses"))
    return stores
