"""Mazes as Doom maps: UDMF text, a few lumps of a WAD file.

The engine builds the nodes of a UDMF map when it loads it, so that a map is text alone. Its axes are the
maze's (x right, y up, angles counter-clockwise from x), scaled by UNITS_PER_M.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ngo_sim.doom_wad import Lump
from ngo_sim.mazes import Maze

UNITS_PER_M = 32.0  # Doom map units in one metre: the one place where the scale of the 3D world is stated.

WALL_HEIGHT_UNITS = 128  # Floor to ceiling; the height of every texture below, so that each shows once and upright.

PLAYER_RADIUS_UNITS = 16  # Half the side of the box with which Doom's player collides.

# Of freedoom2.wad: opaque, 128 units high, static (no animated sequence, no switch), and told apart by colour
# or pattern even at 80 x 60 pixels.
WALL_TEXTURES: tuple[str, ...] = (
    "A-BROCK2", "A-CAMO1", "A-CAMO3", "A-CAMO4", "A-CONCTE", "A-DBRI28", "A-MOSRK2", "A-MOSROK",
    "A-TILE", "AQBRIK02", "AQBRIK03", "AQCONC06", "AQCONC13", "AQPANL03", "AQRUST06", "AQSECT04",
    "AQSECT10", "AQTILE02", "AQTRIM01", "AQTRIM07", "AROCK2", "BIGBRIK3", "BRONZE4", "BROWN1",
    "BSTONE3", "CARLLF2", "CEMENT7", "COMPOHSO", "COMPUTE1", "CRATE3", "ESPIG2", "GRAYTAN9",
    "LITE2", "LITEMET", "MARBGRAY", "MODWALL3", "PANBLUE", "PANBOOK", "PIPE8", "PIPES",
    "REDWALL", "SHAWN01", "SILVER2", "SPACEW2", "SPACEW4", "SP_ROCK1", "STARG2", "STARTAN2",
    "STONE7", "STONEW5", "STWALL", "TEKGREN3", "WOODMET2", "ZZWOLF9",
)  # fmt: skip

# Floors and ceilings, static for the same reason (no liquid, no RROCK05 to 08).
FLATS: tuple[str, ...] = (
    "AQF025", "AQF027", "AQF047", "AQF057", "CEIL3_2", "FLAT1_1", "FLAT5", "FLAT5_4",
    "FLAT8", "FLOOR0_1", "FLOOR0_7", "FLOOR4_6", "FLOOR5_2", "GRASS1", "MFLR8_3", "RROCK11",
    "RROCK16", "SLIME16",
)  # fmt: skip


@dataclass(frozen=True)
class TextureSet:
    """What a maze may be clad with: names of textures for its walls, of flats for its floor and its ceiling."""

    walls: tuple[str, ...]
    flats: tuple[str, ...]


TEXTURE_SETS: dict[str, TextureSet] = {
    "all": TextureSet(WALL_TEXTURES, FLATS),
    "stone": TextureSet(
        ("A-CAMO1", "A-CAMO3", "A-CAMO4", "A-CONCTE", "A-MOSRK2", "A-MOSROK", "AQCONC06", "AQCONC13",
         "AROCK2", "CARLLF2", "CEMENT7", "MARBGRAY", "SP_ROCK1", "STONE7", "STONEW5"),
        ("AQF025", "GRASS1", "MFLR8_3", "RROCK11", "RROCK16"),
    ),
    "brick": TextureSet(
        ("A-BROCK2", "A-DBRI28", "A-TILE", "AQBRIK02", "AQBRIK03", "AQTILE02", "BIGBRIK3", "BRONZE4",
         "BROWN1", "BSTONE3", "SPACEW4", "STWALL", "ZZWOLF9"),
        ("AQF047", "FLAT8", "FLOOR5_2", "SLIME16"),
    ),
    "tech": TextureSet(
        ("COMPOHSO", "COMPUTE1", "CRATE3", "ESPIG2", "GRAYTAN9", "LITE2", "LITEMET", "MODWALL3",
         "SHAWN01", "SILVER2", "STARG2", "STARTAN2", "TEKGREN3"),
        ("CEIL3_2", "FLAT5_4", "FLOOR0_1", "FLOOR0_7"),
    ),
    "industrial": TextureSet(
        ("AQPANL03", "AQRUST06", "AQSECT04", "AQSECT10", "AQTRIM01", "AQTRIM07", "PANBLUE", "PANBOOK",
         "PIPE8", "PIPES", "REDWALL", "SPACEW2", "WOODMET2"),
        ("AQF027", "AQF057", "FLAT1_1", "FLAT5", "FLOOR4_6"),
    ),
}  # fmt: skip
"""Everything by the name "all", and its parts by what they look like: every texture and flat is in one of these."""

DECORATIONS: tuple[int, ...] = (10, 15, 18, 19, 20, 21, 22, 24, 34, 59, 60, 61, 62, 79, 80, 81)
"""Doom's numbers of the things that decorate: remains on the floor, a candle, what hangs from the ceiling.

None of them moves, is in the way or can be taken; 12 looks like 10, 23 vanishes at once and 63 twitches.
"""

_DECORATION_GAP_M = 0.5  # between a decoration's middle and the walls of its block

_LUMP_NAME = re.compile(r"[A-Z0-9_\-\[\]\\]{1,8}")


@dataclass(frozen=True)
class MapStyle:
    """What a maze looks like.

    Attributes:
        wall_textures: (faces,) texture names, one for each face in the order of :func:`wall_faces`.
        floor: Flat of the floor.
        ceiling: Flat of the ceiling.
        light_level: Sector light, 0 (black) to 255 (full).
    """

    wall_textures: tuple[str, ...]
    floor: str
    ceiling: str
    light_level: int = 208

    def __post_init__(self) -> None:
        if not 0 <= self.light_level <= 255:
            raise ValueError(f"light_level is {self.light_level}; it must be from 0 to 255")


@dataclass(frozen=True)
class Decoration:
    """One of DECORATIONS, and where it stands or hangs, m, in the maze's frame."""

    kind: int
    x_m: float
    y_m: float


def wall_faces(walls: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the faces between free and wall blocks as directed grid edges, free block on the right of each.

    Args:
        walls: (height, width) True where a block is wall; the border must be wall.

    Returns:
        (faces, 4) grid corners x0, y0, x1, y1 in blocks; by side (south, west, north, east of the free
        block), then row-major.

    Raises:
        ValueError: If an outer block is free: the map would leak into the void.
    """
    if walls.ndim != 2 or min(walls.shape) < 3:
        raise ValueError(f"walls has shape {walls.shape}; it must be 2-D and at least 3 x 3")
    if not (walls[0].all() and walls[-1].all() and walls[:, 0].all() and walls[:, -1].all()):
        raise ValueError("walls has a free block on the border; it must be closed")
    # Offset (row, col) of the wall block, then the edge's corners from the free block's lower left corner.
    # The engine draws the right side of a line.
    sides = (
        ((-1, 0), (1, 0, 0, 0)),
        ((0, -1), (0, 0, 0, 1)),
        ((1, 0), (0, 1, 1, 1)),
        ((0, 1), (1, 1, 1, 0)),
    )
    faces = []
    for (d_row, d_col), corners in sides:
        row, col = np.nonzero(~walls & np.roll(walls, (-d_row, -d_col), axis=(0, 1)))
        faces.append(np.stack([col, row, col, row], axis=1) + np.array(corners))
    return np.concatenate(faces)


def random_style(face_count: int, rng: np.random.Generator, light_level: int = 208, textures: str = "all") -> MapStyle:
    """Draw a wall texture for each of ``face_count`` faces, one floor and one ceiling, out of a set of textures.

    Raises:
        ValueError: If ``textures`` is none of TEXTURE_SETS.
    """
    if textures not in TEXTURE_SETS:
        raise ValueError(f"textures is {textures!r}; it must be one of {', '.join(TEXTURE_SETS)}")
    walls, flats = TEXTURE_SETS[textures].walls, TEXTURE_SETS[textures].flats
    drawn = rng.integers(len(walls), size=face_count)
    floor, ceiling = rng.choice(len(flats), size=2, replace=False)
    return MapStyle(tuple(walls[i] for i in drawn), flats[floor], flats[ceiling], light_level)


def random_decorations(maze: Maze, count: int, rng: np.random.Generator) -> tuple[Decoration, ...]:
    """Draw ``count`` decorations, each anywhere in a free block but near its walls."""
    free = maze.free_blocks()
    kinds = rng.choice(DECORATIONS, size=count)
    centers = maze.block_center(free[rng.integers(len(free), size=count)])
    reach = maze.block_m / 2 - _DECORATION_GAP_M
    positions = centers + rng.uniform(-reach, reach, size=(count, 2))
    return tuple(Decoration(int(kind), float(x), float(y)) for kind, (x, y) in zip(kinds, positions, strict=True))


def textmap(
    maze: Maze,
    style: MapStyle,
    start_xy: tuple[float, float],
    start_heading_deg: int,
    decorations: Iterable[Decoration] = (),
) -> str:
    """Return the UDMF text of a maze: one sector, one line a wall face, the player and what decorates.

    Args:
        maze: The maze; a block is ``maze.block_m * UNITS_PER_M`` units wide.
        style: Textures, one for each face of ``wall_faces(maze.walls)``.
        start_xy: Where the player starts, m, in the maze's frame.
        start_heading_deg: Its heading in whole degrees (the format has no finer), counter-clockwise from x.
        decorations: What else is in the maze.

    Raises:
        ValueError: If the number of textures differs from the number of faces, or the start is inside a wall.
    """
    faces = wall_faces(maze.walls)
    if len(style.wall_textures) != len(faces):
        raise ValueError(f"style has {len(style.wall_textures)} wall textures; it must have {len(faces)}")
    if maze.walls[maze.block_at(*start_xy)]:
        raise ValueError(f"start_xy is {start_xy}, inside a wall; it must be in a free block")
    corners, ends = np.unique(faces.reshape(-1, 2), axis=0, return_inverse=True)
    ends = ends.reshape(-1, 2)
    block_units = maze.block_m * UNITS_PER_M
    x, y = (value * UNITS_PER_M for value in start_xy)
    parts = [
        'namespace="zdoom";\n',
        thing(1, x, y, int(start_heading_deg) % 360),
        f'sector{{heightfloor=0;heightceiling={WALL_HEIGHT_UNITS};texturefloor="{style.floor}";'
        f'textureceiling="{style.ceiling}";lightlevel={style.light_level};}}\n',
    ]
    parts += [f"vertex{{x={cx * block_units:.4f};y={cy * block_units:.4f};}}\n" for cx, cy in corners]
    parts += [f'sidedef{{sector=0;texturemiddle="{texture}";}}\n' for texture in style.wall_textures]
    parts += [f"linedef{{v1={v1};v2={v2};sidefront={side};blocking=true;}}\n" for side, (v1, v2) in enumerate(ends)]
    parts += [thing(item.kind, item.x_m * UNITS_PER_M, item.y_m * UNITS_PER_M, 0) for item in decorations]
    return "".join(parts)


def thing(kind: int, x: float, y: float, angle: int) -> str:
    """The UDMF text of a thing of one of Doom's numbers at x, y in map units, facing ``angle`` in degrees."""
    return (
        f"thing{{type={kind};x={x:.4f};y={y:.4f};angle={angle};"
        "skill1=true;skill2=true;skill3=true;skill4=true;skill5=true;single=true;coop=true;dm=true;}\n"
    )


def map_lumps(maps: Iterable[tuple[str, str]]) -> list[Lump]:
    """The lumps of (map name, UDMF text) pairs.

    Raises:
        ValueError: If a name is no lump name (1 to 8 of ``A-Z 0-9 _ - [ ] \\``) or occurs twice.
    """
    lumps: list[Lump] = []
    names: set[str] = set()
    for name, text in maps:
        if not _LUMP_NAME.fullmatch(name) or name in names:
            raise ValueError(f"map name is {name!r}; it must be 1 to 8 of A-Z 0-9 _ - [ ] \\, each name once")
        names.add(name)
        lumps += [(name, b""), ("TEXTMAP", text.encode("ascii")), ("ENDMAP", b"")]
    return lumps
