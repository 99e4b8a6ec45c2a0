"""Doom's maps in WADs: which are found, what is left out of them, and which are refused."""

import random
import re
import struct
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ngo_sim.doom_engine import SHIPPED, DoomEngine
from ngo_sim.doom_map import UNITS_PER_M
from ngo_sim.doom_map_check import check_map
from ngo_sim.doom_wad import Lump, Wad, find_wad, read_wad
from ngo_sim.doom_walls import wall_ranges, walls_at
from ngo_sim.maze3d import Maze3D, Maze3DConfig

TEXT = b"""namespace = "zdoom";
thing { type = 1; x = 32; y = 64; }
linedef // 0
{
v1 = 0; v2 = 1; special = 243; sidefront = 0;
}
linedef { v1 = 1; v2 = 2; special = 12; arg0 = 7; }
linedef { v1 = 2; v2 = 3; Special=70; }
sector { special = 74; }
"""


def doom_lines(*specials: int) -> bytes:
    return b"".join(struct.pack("<7H", 1, 2, 3, special, 5, 6, 7) for special in specials)


def doom_map(name: str, lines: bytes = b"", *more: Lump) -> list[Lump]:
    return [(name, b""), ("THINGS", b"t"), ("LINEDEFS", lines), ("SIDEDEFS", b"s"), *more]


def test_maps_are_found_in_both_forms() -> None:
    text_map = [("HOME", b""), ("TEXTMAP", TEXT), ("ZNODES", b""), ("ENDMAP", b"")]
    lumps = [("PALETTE", b""), *doom_map("MAP01"), *doom_map("MAP02"), *text_map, ("THINGSX", b"")]
    wad = Wad(Path("some.wad"), False, tuple(lumps))
    assert wad.maps() == {"MAP01": range(1, 5), "MAP02": range(5, 9), "HOME": range(9, 13)}


def test_lines_that_leave_the_level_or_teleport_are_plain_lines_in_the_copy() -> None:
    wad = Wad(Path("some.wad"), True, tuple(doom_map("E1M1", doom_lines(0, 1, 11, 52, 97, 124, 62))))
    assert dict(wad.still_map("e1m1"))["LINEDEFS"] == doom_lines(0, 1, 0, 0, 0, 0, 62)


def test_the_same_in_hexens_form_and_no_script_is_left() -> None:
    def lines(*specials: int) -> bytes:
        return b"".join(struct.pack("<3H6B2H", 1, 2, 3, special, 9, 9, 9, 9, 9, 6, 7) for special in specials)

    scripts = ("BEHAVIOR", b"ACS\0 a script"), ("SCRIPTS", b"source")
    wad = Wad(Path("some.wad"), False, tuple(doom_map("MAP01", lines(243, 12, 70, 11), *scripts)))
    still = dict(wad.still_map("MAP01"))
    assert still["LINEDEFS"] == lines(0, 12, 0, 11)
    assert still["BEHAVIOR"] == b"ACS\0" + struct.pack("<iii", 8, 0, 0) and "SCRIPTS" not in still


def test_the_same_in_the_text_form() -> None:
    scripts = [(name, b"x") for name in ("BEHAVIOR", "SCRIPTS", "DIALOGUE")]
    lumps = [("MAP01", b""), ("TEXTMAP", TEXT), *scripts, ("ENDMAP", b"")]
    still = dict(Wad(Path("some.wad"), False, tuple(lumps)).still_map("map01"))
    assert list(still) == ["MAP01", "TEXTMAP", "ENDMAP"]
    blocks = re.findall(r"(linedef|sector)[^{]*\{([^}]*)\}", still["TEXTMAP"].decode())
    specials = [re.findall(r"special\s*=\s*(\d+)", block) for _, block in blocks]
    assert specials == [[], ["12"], [], ["74"]], "a door stays, and a sector's number means something else"
    doom = TEXT.replace(b"zdoom", b"doom").replace(b"= 243", b"= 11")
    lumps[1] = ("TEXTMAP", doom)
    assert b"= 11;" not in dict(Wad(Path("some.wad"), False, tuple(lumps)).still_map("MAP01"))["TEXTMAP"]


def test_beside_a_game_the_map_alone_is_loaded_of_another_file_all_but_its_other_maps() -> None:
    lumps = (("TEXTURE", b"x"), *doom_map("MAP01"), *doom_map("MAP02"))
    of_game, of_other = (Wad(Path("a.wad"), is_game, lumps).with_still_map("MAP02") for is_game in (True, False))
    assert [name for name, _ in of_game] == ["MAP02", "THINGS", "LINEDEFS", "SIDEDEFS"]
    assert of_other == [("TEXTURE", b"x"), *of_game]


def test_a_map_that_is_not_there_is_named_with_those_that_are() -> None:
    wad = Wad(Path("some.wad"), False, (*doom_map("MAP01"), *doom_map("MAP02")))
    with pytest.raises(ValueError, match=r"^map is 'map07'; some\.wad has MAP01, MAP02$"):
        wad.still_map("map07")
    with pytest.raises(ValueError, match=r"^map is 'MAP01'; none\.wad has none$"):
        Wad(Path("none.wad"), False, (("TEXTURE", b""),)).still_map("MAP01")


def test_a_file_is_found_by_its_path_before_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shipped, working = tmp_path / "shipped", tmp_path / "working"
    for path in (shipped / "scenarios" / "room.wad", shipped / "game.wad", working / "own" / "room.wad"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    monkeypatch.chdir(working)
    assert find_wad("own/room.wad", shipped) == working / "own" / "room.wad"
    assert find_wad("room.wad", shipped) == shipped / "scenarios" / "room.wad"
    assert find_wad("game.wad", shipped) == shipped / "game.wad"
    with pytest.raises(ValueError, match=r"^wad is 'hall\.wad'; it must be a WAD file, or .* game\.wad, room\.wad$"):
        find_wad("hall.wad", shipped)


def line(*ends_m: float) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip(("x1", "y1", "x2", "y2"), (UNITS_PER_M * end for end in ends_m), strict=True)))


def sector(floor: float, ceiling: float, *lines: SimpleNamespace) -> SimpleNamespace:
    return SimpleNamespace(floor_height=floor, ceiling_height=ceiling, lines=lines)


def test_a_step_below_the_eye_is_no_wall_and_one_above_it_is() -> None:
    between, behind = line(2.0, -1.0, 2.0, 1.0), line(5.0, -1.0, 5.0, 1.0)
    angles = np.array([0.0, np.pi])
    for height, expected in ((16.0, 5.0), (64.0, 2.0)):
        sectors = [sector(0.0, 128.0, between), sector(height, 128.0, line(2.0, 1.0, 2.0, -1.0), behind)]
        ranges = wall_ranges(walls_at(sectors, 41.0), np.zeros(3), angles)
        assert ranges.dtype == np.float32
        np.testing.assert_allclose(ranges, [expected, np.inf], atol=1e-6)


HOME = SHIPPED / "scenarios" / "my_way_home.wad"
ROOM_TEXT = """namespace = "zdoom"; // a room
vertex { x = -64.0; y = 0; } vertex { x = 64; y = 1.5e1; } vertex { x = 0; y = 99; }
/* lines */ linedef { v1 = 0; v2 = 1; sidefront = 0; blocking = true; comment = "a // \\" }"; }
linedef { v1 = 1; v2 = 2; sidefront = 0; sideback = -1; } linedef { v1 = 2; v2 = 0; sidefront = 0; }
sidedef { sector = 0; texturemiddle = "X"; } sector { heightceiling = 128; }
thing { type = 1; x = 0; y = 32; }
"""


def text_map(text: str) -> list[Lump]:
    return [("MAP01", b""), ("TEXTMAP", text.encode("latin-1")), ("ENDMAP", b"")]


def binary_map(**changes: bytes) -> list[Lump]:
    parts = {
        "THINGS": struct.pack("<5H", 0, 0, 90, 1, 7),
        "LINEDEFS": b"".join(struct.pack("<7H", *ends, 0, 0, 0, 0, 0xFFFF) for ends in ((0, 1), (1, 2), (2, 0))),
        "SIDEDEFS": struct.pack("<2h24sH", 0, 0, b"", 0),
        "VERTEXES": struct.pack("<6h", 0, 0, 64, 0, 0, 64),
        "SECTORS": bytes(26),
    }
    return [("MAP01", b""), *{**parts, **changes}.items()]


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("v2 = 1", "v2 = 3", "linedef 0 has v2 3; there are 3 vertex blocks"),
        ("v2 = 1;", "", "linedef 0 has v2 none"),
        ("sidefront = 0", "sidefront = -1", "linedef 0 has sidefront -1"),
        ("sideback = -1", "sideback = 1", "linedef 1 has sideback 1"),
        ("sector = 0", "sector = 1", "sidedef 0 has sector 1"),
        ("x = 64", "x = 1e9", "vertex 1 has x 1e9; expected a number up to 32767"),
        ("x = 0; y = 32", "y = 32", "thing 0 has x none"),
        ("type = 1", "type = 11", "no start of the player"),
        ("sector {", "sectar {", "it has no sector"),
        ("y = 0;", "y = 0\x91;", "its vertex cannot be read at character"),
        ("vertex {", "vertex (", "its text cannot be read from character"),
        ('"zdoom"', '"zdoom', "its text cannot be read"),
        ("}\n", "", "cannot be read"),
    ],
)
def test_what_is_wrong_with_a_text_map_is_named(old: str, new: str, complaint: str) -> None:
    assert old in ROOM_TEXT
    with pytest.raises(ValueError, match=re.escape(complaint)) as error:
        check_map(text_map(ROOM_TEXT.replace(old, new, 1) if old != "}\n" else ROOM_TEXT[:-4]))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"SECTORS": b""}, "SECTORS has 0 bytes; expected records of 26"),
        ({"VERTEXES": bytes(11)}, "VERTEXES has 11 bytes; expected records of 4"),
        ({"VERTEXES": bytes(8)}, "line 1 joins vertices 1 and 2; there are 2"),
        ({"LINEDEFS": struct.pack("<7H", 0, 1, 0, 0, 0, 0xFFFF, 0)}, "line 0 has the sides 65535 and 0; there are 1"),
        ({"SIDEDEFS": struct.pack("<2h24sH", 0, 0, b"", 4)}, "side 0 is of sector 4; there are 1"),
        ({"THINGS": struct.pack("<5H", 0, 0, 0, 11, 7)}, "no start of the player"),
        ({"BEHAVIOR": b""}, "SIDEDEFS|LINEDEFS has 42 bytes; expected records of 16"),
    ],
)
def test_what_is_wrong_with_a_binary_map_is_named(changes: dict[str, bytes], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        check_map(binary_map(**changes))


def mutant(path: Path, seed: int, changed: int = 19) -> Path:
    rng, content = random.Random(seed), bytearray(HOME.read_bytes())
    for _ in range(changed):
        content[rng.randrange(12, len(content))] = rng.randrange(256)
    path.write_bytes(content)
    return path


def test_a_map_with_which_the_engine_dies_ends_another_process() -> None:
    """A map that the check would refuse: started here, the engine would end this process with SIGSEGV."""
    engine = DoomEngine(80, 60, 90, 2)
    deadly = [(name, data[:-9] if name == "TEXTMAP" else data) for name, data in read_wad(HOME).lumps]
    with pytest.raises(ValueError, match="map is 'MAP01', which is damaged: the engine cannot run it") as error:
        engine.start(deadly, "MAP01", harmless=True, rehearse=True)
    assert "\n" not in str(error.value) and not engine.running


def test_a_good_map_of_others_is_rehearsed_and_then_driven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "home.wad").write_bytes(HOME.read_bytes())
    commands, run = [], subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda command, **named: commands.append(command) or run(command, **named))
    env = Maze3D(Maze3DConfig(wad=str(tmp_path / "home.wad"), map="MAP01"))
    env.reset(seed=0)
    env.reset(seed=1)
    env.close()
    assert len(commands) == 1 and commands[0][1:3] == ["-m", "ngo_sim.doom_engine"]
