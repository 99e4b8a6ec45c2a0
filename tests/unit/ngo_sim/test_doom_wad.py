import re
import struct
from pathlib import Path

import pytest

from ngo_sim.doom_wad import Lump, Wad, find_wad

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
