import importlib.util
import itertools
import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ngo_sim.doom_map import (
    DECORATIONS,
    FLATS,
    UNITS_PER_M,
    WALL_HEIGHT_UNITS,
    WALL_TEXTURES,
    map_lumps,
    random_decorations,
    random_style,
    textmap,
    wall_faces,
)
from ngo_sim.doom_wad import write_lumps
from ngo_sim.mazes import Maze, kruskal_maze

Lump = tuple[str, bytes]


def read_wad(path: Path) -> tuple[str, list[Lump]]:
    """A WAD's kind and its lumps, read as the format's description says."""
    data = path.read_bytes()
    kind, count, directory = struct.unpack_from("<4sii", data)
    lumps = []
    for index in range(count):
        offset, size, name = struct.unpack_from("<ii8s", data, directory + 16 * index)
        lumps.append((name.rstrip(b"\0").decode(), data[offset : offset + size]))
    return kind.decode(), lumps


def blocks_of(text: str, kind: str) -> list[dict[str, str]]:
    """The fields of every `kind {...}` of a UDMF text."""
    found = re.findall(rf"^{kind}\{{(.*)\}}$", text, re.MULTILINE)
    return [dict(re.findall(r'(\w+)="?([^;"]*)"?;', fields)) for fields in found]


def small_maze(seed: int = 0) -> Maze:
    return kruskal_maze(4, 5, np.random.default_rng(seed), extra_openings=3, block_m=3.0)


def test_every_face_has_a_free_block_on_its_right_and_a_wall_on_its_left() -> None:
    maze = small_maze()
    faces = wall_faces(maze.walls)
    start, end = faces[:, :2], faces[:, 2:]
    along = end - start
    right = np.stack((along[:, 1], -along[:, 0]), axis=1)
    middle = (start + end) / 2
    for side, wall in ((right, False), (-right, True)):
        col, row = np.floor(middle + side / 2).astype(int).T
        assert (maze.walls[row, col] == wall).all()
    padded = maze.walls.astype(int)
    changes = np.abs(np.diff(padded, axis=0)).sum() + np.abs(np.diff(padded, axis=1)).sum()
    assert len(faces) == len(np.unique(faces, axis=0)) == changes


def test_an_open_border_is_refused() -> None:
    walls = np.ones((5, 5), dtype=bool)
    walls[1, 0] = False
    with pytest.raises(ValueError, match="free block on the border"):
        wall_faces(walls)


def test_the_text_is_the_maze_at_32_units_a_metre() -> None:
    maze = small_maze()
    faces = wall_faces(maze.walls)
    style = random_style(len(faces), np.random.default_rng(1), light_level=150)
    text = textmap(maze, style, (4.5, 10.5), start_heading_deg=-90)
    vertices = np.array([[float(v["x"]), float(v["y"])] for v in blocks_of(text, "vertex")])
    lines = blocks_of(text, "linedef")
    ends = np.array([[int(line["v1"]), int(line["v2"])] for line in lines])
    np.testing.assert_array_equal(vertices[ends].reshape(-1, 4), faces * 3.0 * UNITS_PER_M)
    sides = blocks_of(text, "sidedef")
    assert [sides[int(line["sidefront"])]["texturemiddle"] for line in lines] == list(style.wall_textures)
    assert blocks_of(text, "sector") == [{
        "heightfloor": "0", "heightceiling": "128", "texturefloor": style.floor,
        "textureceiling": style.ceiling, "lightlevel": "150"}]  # fmt: skip
    (player,) = blocks_of(text, "thing")
    assert (float(player["x"]), float(player["y"]), player["angle"]) == (144.0, 336.0, "270")
    assert player["type"] == "1"


def test_decorations_are_of_all_kinds_in_free_blocks_and_off_the_walls() -> None:
    maze = small_maze()
    drawn = random_decorations(maze, 500, np.random.default_rng(0))
    assert len(drawn) == 500 and {item.kind for item in drawn} == set(DECORATIONS)
    assert drawn == random_decorations(maze, 500, np.random.default_rng(0))
    assert random_decorations(maze, 0, np.random.default_rng(0)) == ()
    for item in drawn:
        for dx, dy in itertools.product((-0.49, 0.49), repeat=2):
            assert not maze.walls[maze.block_at(item.x_m + dx, item.y_m + dy)]


def test_a_pwad_holds_the_maps_in_order(tmp_path: Path) -> None:
    path = tmp_path / "maps.wad"
    write_lumps(path, map_lumps([("M0", "first"), ("M1", "second one")]))
    assert read_wad(path) == ("PWAD", [
        ("M0", b""), ("TEXTMAP", b"first"), ("ENDMAP", b""),
        ("M1", b""), ("TEXTMAP", b"second one"), ("ENDMAP", b"")])  # fmt: skip


def vizdoom_folder() -> Path:
    spec = importlib.util.find_spec("vizdoom")
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).parent


def animated_ranges() -> list[tuple[str, str]]:
    """First and last name of every animated sequence that the engine knows by itself."""
    with zipfile.ZipFile(vizdoom_folder() / "vizdoom.pk3") as archive:
        table = archive.read("animated.lmp")
    rows = [struct.unpack_from("<b9s9s", table, offset) for offset in range(0, len(table) - 22, 23)]
    return [(first.split(b"\0")[0].decode(), last.split(b"\0")[0].decode()) for kind, last, first in rows if kind >= 0]


def test_textures_exist_are_as_high_as_a_wall_and_never_change() -> None:
    _, lumps = read_wad(vizdoom_folder() / "freedoom2.wad")
    by_name = dict(lumps)
    assert not {"ANIMDEFS", "ANIMATED", "SWITCHES"} & set(by_name), "more animations than the engine's own"
    table = by_name["TEXTURE1"]
    (count,) = struct.unpack_from("<i", table)
    offsets = struct.unpack_from(f"<{count}i", table, 4)
    headers = [struct.unpack_from("<8sihh", table, offset) for offset in offsets]
    heights = {name.rstrip(b"\0").decode(): height for name, _, _, height in headers}
    assert {heights[name] for name in WALL_TEXTURES} == {WALL_HEIGHT_UNITS}
    flats = [name for name, data in lumps if len(data) == 64 * 64]
    assert set(FLATS) <= set(flats)
    order = list(heights)
    for first, last in animated_ranges():
        for names, used in ((order, WALL_TEXTURES), (flats, FLATS)):
            if first in names and last in names:
                sequence = names[names.index(first) : names.index(last) + 1]
                assert not set(sequence) & set(used), f"animated: {first} to {last}"
    assert not [name for name in WALL_TEXTURES if name.startswith(("SW1", "SW2", "SKY"))]
    assert len(set(WALL_TEXTURES)) == len(WALL_TEXTURES) >= 44 and len(set(FLATS)) == len(FLATS) >= 16
