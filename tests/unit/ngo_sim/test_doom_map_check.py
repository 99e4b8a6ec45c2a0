"""Maps of others are checked before the engine loads them, and tried in a process that may die."""

import random
import re
import struct
import subprocess
from pathlib import Path

import pytest

from ngo_sim.doom_engine import SHIPPED, DoomEngine
from ngo_sim.doom_map_check import check_map
from ngo_sim.doom_wad import Lump, read_wad
from ngo_sim.maze3d import Maze3D, Maze3DConfig

HOME = SHIPPED / "scenarios" / "my_way_home.wad"
TEXT = """namespace = "zdoom"; // a room
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
    assert old in TEXT
    with pytest.raises(ValueError, match=re.escape(complaint)) as error:
        check_map(text_map(TEXT.replace(old, new, 1) if old != "}\n" else TEXT[:-4]))
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
