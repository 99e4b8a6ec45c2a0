"""Doom maps that others made: found, and copied so that nothing in them ends an episode or moves the player.

In the copy no line leads out of the level or teleports, and no script runs; doors, lifts and switches stay.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ngo_common.files import read_file

Lump = tuple[str, bytes]

# Numbers of line types: of Doom and Boom (exits, then teleporters), and of Hexen, which ZDoom's text format shares.
_DOOM_LINES = {
    *(11, 51, 52, 124, 197, 198),
    *(39, 97, 125, 126, 174, 195, 207, 208, 209, 210, 243, 244, *range(262, 270)),
}
_HEXEN_LINES = {74, 75, 243, 244, *(39, 70, 71, 76, 77, 78, 154, 215)}
_SCRIPTS = {"BEHAVIOR", "SCRIPTS", "DIALOGUE"}
_BINARY_MAP = {
    *("THINGS", "LINEDEFS", "SIDEDEFS", "VERTEXES", "SEGS", "SSECTORS", "NODES", "SECTORS", "REJECT", "BLOCKMAP"),
    *("BEHAVIOR", "SCRIPTS", "DIALOGUE"),
}
_MOST_SHARED = 8
_EMPTY_SCRIPTS = b"ACS\0" + struct.pack("<iii", 8, 0, 0)


@dataclass(frozen=True)
class Wad:
    """A WAD file: whether it is a whole game (IWAD), and its named lumps in order."""

    path: Path
    is_game: bool
    lumps: tuple[Lump, ...]

    def maps(self) -> dict[str, range]:
        """The lumps of each map, its marker first, by the map's name."""
        found = {}
        for first, (name, _) in enumerate(self.lumps[:-1]):
            after = self.lumps[first + 1][0]
            end = first + 1
            if after == "TEXTMAP":
                while end < len(self.lumps) and self.lumps[end][0] != "ENDMAP":
                    end += 1
                found[name] = range(first, min(end + 1, len(self.lumps)))
            elif after == "THINGS":
                while end < len(self.lumps) and self.lumps[end][0] in _BINARY_MAP:
                    end += 1
                found[name] = range(first, end)
        return found

    def map_lumps(self, name: str) -> list[Lump]:
        """The lumps of the map of this name (in any case). Raises ValueError where there is none."""
        maps = self.maps()
        if name.upper() not in maps:
            raise ValueError(f"map is {name!r}; {self.path.name} has {', '.join(maps) or 'none'}")
        return [self.lumps[index] for index in maps[name.upper()]]

    def still_map(self, name: str) -> list[Lump]:
        """The lumps of the map of this name (in any case), without exits, teleporters and scripts.

        Raises ValueError where there is none.
        """
        lumps = self.map_lumps(name)
        names = {lump for lump, _ in lumps}
        if "TEXTMAP" in names:
            return [
                (lump, _still_text(data) if lump == "TEXTMAP" else data) for lump, data in lumps if lump not in _SCRIPTS
            ]
        still = dict(lumps)
        still["LINEDEFS"] = _still_lines(still["LINEDEFS"], hexen="BEHAVIOR" in names)
        if "BEHAVIOR" in names:  # by it the engine knows the format
            still["BEHAVIOR"] = _EMPTY_SCRIPTS
        return [(lump, data) for lump, data in still.items() if lump not in ("SCRIPTS", "DIALOGUE")]

    def with_still_map(self, name: str) -> list[Lump]:
        """What to load beside the game: the still map alone of a game, of another file all but its other maps."""
        still = self.still_map(name)
        if self.is_game:
            return still
        of_maps = {index for indices in self.maps().values() for index in indices}
        return [*(lump for index, lump in enumerate(self.lumps) if index not in of_maps), *still]


def find_wad(wad: str, shipped: Path) -> Path:
    """The file at the path `wad`, or else of this name in the folder `shipped` or its `scenarios`.

    Raises ValueError where there is none.
    """
    given = Path(wad).expanduser()
    for path in (given, shipped / wad, shipped / "scenarios" / wad):
        if path.is_file():
            return path.resolve()
    names = sorted(path.name for folder in (shipped, shipped / "scenarios") for path in folder.glob("*.wad"))
    raise ValueError(f"wad is {wad!r}; it must be a WAD file, or the name of one of {', '.join(names)}")


def read_wad(path: Path) -> Wad:
    """Read a WAD file. Raises ValueError where it is none."""
    content = read_file(path)
    try:
        magic, count, offset = struct.unpack_from("<4sii", content)
        entries = [struct.unpack_from("<ii8s", content, offset + 16 * index) for index in range(count)]
        if magic not in (b"IWAD", b"PWAD") or any(at < 0 or at + size > len(content) for at, size, _ in entries):
            raise ValueError(magic)
        if sum(size for _, size, _ in entries) > _MOST_SHARED * len(content):  # the same bytes over and over
            raise ValueError(count)
        lumps = [(name.split(b"\0")[0].decode("ascii").upper(), content[at : at + size]) for at, size, name in entries]
    except (struct.error, ValueError):
        raise ValueError(f"wad is {str(path)!r}, which is damaged or no WAD file") from None
    return Wad(path, magic == b"IWAD", tuple(lumps))


def write_lumps(path: Path, lumps: Iterable[Lump]) -> None:
    """Write lumps, in order, as one PWAD."""
    body, directory, offset = [], [], 12
    for name, data in lumps:
        directory.append(struct.pack("<ii8s", offset, len(data), name.encode("ascii")))
        body.append(data)
        offset += len(data)
    path.write_bytes(b"".join([struct.pack("<4sii", b"PWAD", len(directory), offset), *body, *directory]))


def _still_lines(data: bytes, hexen: bool) -> bytes:
    """Lines of the binary formats with the types that must not act set to 0."""
    still = bytearray(data)
    if hexen:
        for at in range(6, len(data), 16):
            if data[at] in _HEXEN_LINES:
                still[at] = 0
    else:
        for at in range(6, len(data), 14):
            if struct.unpack_from("<H", data, at)[0] in _DOOM_LINES:
                struct.pack_into("<H", still, at, 0)
    return bytes(still)


def _still_text(data: bytes) -> bytes:
    """The text format with the line types that must not act taken out."""
    text = data.decode("latin-1")
    doom = re.match(r"\s*(//.*\s*)*namespace\s*=\s*\"doom\"", text, re.IGNORECASE)
    forbidden = _DOOM_LINES if doom else _HEXEN_LINES

    def still(block: re.Match[str]) -> str:
        special = re.search(r"\bspecial\s*=\s*(\d+)\s*;", block.group(), re.IGNORECASE)
        if special is None or int(special.group(1)) not in forbidden:
            return block.group()
        return block.group().replace(special.group(), "")

    return re.sub(r"\blinedef\b[^{]*\{[^}]*\}", still, text, flags=re.IGNORECASE).encode("latin-1")
