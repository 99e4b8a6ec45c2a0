"""One Doom map of a file, with the game that it belongs to."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ngo_sim.doom_engine import SHIPPED
from ngo_sim.doom_map_check import check_map
from ngo_sim.doom_wad import Lump, find_wad, read_wad


@dataclass(frozen=True)
class DoomLevel:
    """What the engine loads: the game, the lumps beside it, and the map's name in them; shipped: by ViZDoom."""

    game_wad: Path
    lumps: tuple[Lump, ...]
    name: str
    shipped: bool


def load_level(wad: str, name: str) -> DoomLevel:
    """The map of this name (in any case) of a WAD file, a path or the name of one that ViZDoom ships.

    What ends an episode or moves the player is taken out (see doom_wad). A file that is no whole game takes what it
    lacks from freedoom: a map called E1M1 to E4M9 from its first part, any other from its second.

    Raises ValueError where file or map are not there, or the map cannot be played.
    """
    file = read_wad(find_wad(wad, SHIPPED))
    original = file.map_lumps(name)
    try:
        check_map(original)
    except ValueError as error:
        raise ValueError(f"map is {name!r} of {file.path.name}, which cannot be played: {error}") from None
    lumps = file.with_still_map(name)
    first = re.fullmatch(r"E\dM\d", name.upper()) is not None
    freedoom = SHIPPED / ("freedoom1.wad" if first else "freedoom2.wad")
    game_wad, shipped = file.path if file.is_game else freedoom, file.path.is_relative_to(SHIPPED)
    return DoomLevel(game_wad, tuple(lumps), name.upper(), shipped)


# Numbers of things that lie or begin where a player can be: starts, those of deathmatches, weapons, ammunition, health.
_REACHABLE = {1, 2, 3, 4, 11, 2001, 2002, 2003, 2005, 2007, 2008, 2010, 2011, 2012, 2014, 2015, 2018, 2019, 2046, 2047,
              2048, 2049}  # fmt: skip


def with_drawn_start(level: DoomLevel, rng: np.random.Generator) -> DoomLevel:
    """The level with the player's start where a thing lies that a player can pick up, and facing any way.

    Raises ValueError for a map in another format than Doom's binary one.
    """
    lumps = dict(level.lumps)
    if "THINGS" not in lumps or "BEHAVIOR" in lumps:
        raise ValueError(f"map is {level.name!r}; a start is drawn in maps of Doom's own format alone")
    things = [list(entry) for entry in struct.iter_unpack("<hhHHH", lumps["THINGS"])]
    x, y = things[int(rng.choice([index for index, entry in enumerate(things) if entry[3] in _REACHABLE]))][:2]
    angle = int(rng.integers(360))
    moved = [[x, y, angle, *entry[3:]] if entry[3] == 1 else entry for entry in things]
    data = b"".join(struct.pack("<hhHHH", *entry) for entry in moved)
    return replace(level, lumps=tuple((name, data if name == "THINGS" else old) for name, old in level.lumps))
