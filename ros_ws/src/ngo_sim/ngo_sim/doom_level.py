"""One Doom map of a file, with the game that it belongs to."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

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
