"""Drives of ``world:=doom``: through generated levels of rooms, through freedoom's maps, and through mazes.

What is driven follows from the seed alone. Seeds that something learns from take freedoom's training maps; those of
validation, and the last ones of the optimizer, which calibrate the local network, take the maps for validation. The
test maps are in no seed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ngo_sim.episodes import Episode, record_episode
from ngo_sim.maze3d import Maze3D, Maze3DConfig
from training.data.worlds import OPTIMIZER_TRAIN_SEEDS, TRAIN_SEEDS, WORLDS

Watch = Callable[[Any, np.ndarray], None]
"""What is called with the world and the observation of each frame, and may ask the world for its walls."""

Map = tuple[str, str]  # A WAD file that ViZDoom ships, and the name of a map in it.

TRAIN_MAPS: tuple[Map, ...] = (
    *(("freedoom2.wad", f"MAP{number:02}") for number in range(1, 17)),
    *(("freedoom1.wad", f"E{episode}M{number}") for episode in range(1, 5) for number in range(1, 10)),
)
VALIDATION_MAPS: tuple[Map, ...] = tuple(("freedoom2.wad", f"MAP{number:02}") for number in range(17, 21))
TEST_MAPS: tuple[Map, ...] = (
    *(("freedoom2.wad", f"MAP{number:02}") for number in range(21, 33)),
    *((f"{name}.wad", "MAP01") for name in (
        "basic", "deadly_corridor", "deathmatch", "defend_the_center", "defend_the_line", "health_gathering",
        "health_gathering_supreme", "multi_deathmatch", "my_way_home", "predict_position",
        "rocket_basic", "simpler_basic", "take_cover",
    )),
    ("cig.wad", "MAP02"),
)  # fmt: skip
"""All scenarios of ViZDoom that have a start for a single player; ``basic`` stands for its variants with sounds."""

ROOMS: Map = ("rooms", "")  # Stands for the generated level of a drive's seed.

MAZES: Map = ("mazes", "")  # Stands for the maze of a drive's seed.

_PLACES, _PLACE_SHARES = ("map", "rooms", "maze"), (0.5, 0.3, 0.2)
_DRIVERS = {
    "map": (("explorer", "learned", "random"), (0.85, 0.1, 0.05)),
    "rooms": (("explorer", "learned", "random"), (0.65, 0.3, 0.05)),
    "maze": (("random_goals", "learned", "explorer"), (0.65, 0.15, 0.2)),
}
_ONE_BY_ONE = (*("map",) * 4, "rooms", "rooms", "maze", "maze")
CALIBRATION = 1000  # The last ones of the optimizer's seeds, which drive on the maps for validation.


def map_drive(
    of: Map, seed: int, frames: int, driver: str = "explorer", drawn_start: bool = False, watch: Watch | None = None
) -> Episode:
    """A drive of ``frames`` frames on a map, from its own start or one that the seed draws."""
    if of == MAZES:
        env = WORLDS["maze3d"].make_random(np.random.default_rng(seed), tells_walls=watch is not None)
        try:
            return record_episode(env, "random_goals", frames, seed, watch=watch)
        finally:
            env.close()
    config = Maze3DConfig(level="rooms") if of == ROOMS else Maze3DConfig(wad=of[0], map=of[1])
    env = Maze3D(config, tells_walls=watch is not None)
    try:
        return record_episode(env, driver, frames, seed, {"drawn_start": True} if drawn_start else None, watch)
    finally:
        env.close()


def doom_episodes(seeds: Sequence[int], frames: int, watch: Watch | None = None) -> Iterator[Episode]:
    """Episodes of ``frames`` frames, one for each of ``seeds``.

    Training seeds share what the first one draws: levels or mazes of their own, or one long drive on a map, in parts.
    Of other seeds each has its own, in turn maps, rooms and mazes.
    """
    if seeds[0] in TRAIN_SEEDS:
        rng = np.random.default_rng([seeds[0], 2])
        place = str(rng.choice(_PLACES, p=_PLACE_SHARES))
        names, shares = _DRIVERS[place]
        driver = str(rng.choice(names, p=shares))
        if place == "map":
            of = TRAIN_MAPS[int(rng.integers(len(TRAIN_MAPS)))]
            long = map_drive(of, seeds[0], len(seeds) * (frames - 1) + 1, driver, True, watch)
            yield from _parts(long, frames)
        else:
            yield from _levels(place, seeds, frames, driver, rng, watch)
        return
    for seed in seeds:
        place, rng = _ONE_BY_ONE[seed % len(_ONE_BY_ONE)], np.random.default_rng([seed, 2])
        learned_from = seed in OPTIMIZER_TRAIN_SEEDS and seed < OPTIMIZER_TRAIN_SEEDS[-CALIBRATION]
        if place == "map" and learned_from:
            of = TRAIN_MAPS[int(rng.integers(len(TRAIN_MAPS)))]
            yield map_drive(of, seed, frames, drawn_start=True, watch=watch)
        elif place == "map":
            yield map_drive(VALIDATION_MAPS[seed % len(VALIDATION_MAPS)], seed, frames, watch=watch)
        else:
            yield from _levels(place, [seed], frames, _DRIVERS[place][0][seed % 2], rng, watch)


def _levels(
    place: str, seeds: Sequence[int], frames: int, driver: str, rng: np.random.Generator, watch: Watch | None
) -> Iterator[Episode]:
    """An episode in the level or the maze of each seed; the size of all mazes is drawn by ``rng``."""
    env: Any
    if place == "rooms":
        env = Maze3D(Maze3DConfig(level="rooms"), tells_walls=watch is not None)
    else:
        env = WORLDS["maze3d"].make_random(rng, tells_walls=watch is not None)
    try:
        env.preload(seeds)
        for seed in seeds:
            yield record_episode(env, driver, frames, seed, watch=watch)
    finally:
        env.close()


def _parts(drive: Episode, frames: int) -> Iterator[Episode]:
    """A long drive in parts of ``frames`` frames, each of which begins with the last frame of the one before."""
    for first in range(0, len(drive.observations) - 1, frames - 1):
        yield dataclasses.replace(
            drive,
            observations=drive.observations[first : first + frames],
            actions=drive.actions[first : first + frames - 1],
            poses_xyyaw=drive.poses_xyyaw[first : first + frames],
        )
