"""Doom maps that others made, checked before the engine loads them: it dies of lines that lead nowhere."""

from __future__ import annotations

import re
import struct
from collections import defaultdict
from collections.abc import Iterable

from ngo_sim.doom_wad import Lump

_PLAYER = 1
_FARTHEST_UNITS = 32767.0
# One that is not closed goes on to the end: to look for its end from every place would take for ever.
_COMMENT = re.compile(r'("(?:[^"\\]|\\.)*(?:"|\\?\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_VALUE = r'"(?:[^"\\]|\\.)*"|[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|0[xX][0-9a-fA-F]+|true|false'
_SETTING = re.compile(rf"\s*(\w+)\s*=\s*({_VALUE})\s*;", re.IGNORECASE)
_BLOCK, _END = re.compile(r"\s*(\w+)\s*\{"), re.compile(r"\s*\}")
_NO_SIDE = 0xFFFF
# Bytes of a record and where its references stand: in Doom's form, and in Hexen's.
_SIZES = {"VERTEXES": (4, 4), "SIDEDEFS": (30, 30), "SECTORS": (26, 26), "LINEDEFS": (14, 16), "THINGS": (10, 20)}

_Blocks = dict[str, list[dict[str, str]]]


def check_map(lumps: Iterable[Lump]) -> None:
    """Raise ``ValueError`` where a map, its marker first, cannot be played: what is wrong, and in which part."""
    found = dict(lumps)
    if "TEXTMAP" in found:
        _check_text(found["TEXTMAP"].decode("latin-1"))
    else:
        _check_binary(found)


def _check_text(text: str) -> None:
    blocks = _parsed(_COMMENT.sub(lambda match: match.group(1) or " ", text))
    counts = {kind: len(blocks[kind]) for kind in ("vertex", "linedef", "sidedef", "sector")}
    if missing := [kind for kind, count in counts.items() if not count]:
        raise ValueError(f"it has no {missing[0]}")
    references = {
        "linedef": {"v1": "vertex", "v2": "vertex", "sidefront": "sidedef", "sideback": "sidedef"},
        "sidedef": {"sector": "sector"},
    }
    for kind, names in references.items():
        for number, block in enumerate(blocks[kind]):
            for name, target in names.items():
                value = block.get(name, "-1" if name == "sideback" else "none")
                if name == "sideback" and value == "-1":
                    continue
                if not re.fullmatch(r"\d{1,9}", value) or int(value) >= counts[target]:
                    raise ValueError(
                        f"{kind} {number} has {name} {value[:20]}; there are {counts[target]} {target} blocks"
                    )
    for kind in ("vertex", "thing"):
        for number, block in enumerate(blocks[kind]):
            for name in ("x", "y"):
                _check_place(f"{kind} {number}", name, block.get(name, "none"))
    if not any(block.get("type") == str(_PLAYER) for block in blocks["thing"]):
        raise ValueError("it has no start of the player")


def _parsed(text: str) -> _Blocks:
    """The blocks of a text map by their kind."""
    blocks: _Blocks = defaultdict(list)
    at, end = 0, len(text.rstrip(" \t\r\n\0"))
    while at < end:
        if match := _SETTING.match(text, at):
            at = match.end()
            continue
        if not (opened := _BLOCK.match(text, at)):
            raise ValueError(f"its text cannot be read from character {at} on: {text[at : at + 30].strip()!r}")
        at, block = opened.end(), {}
        while match := _SETTING.match(text, at):
            block[match.group(1).lower()] = match.group(2)
            at = match.end()
        if not (closed := _END.match(text, at)):
            raise ValueError(f"its {opened.group(1)} cannot be read at character {at}: {text[at : at + 30].strip()!r}")
        blocks[opened.group(1).lower()].append(block)
        at = closed.end()
    return blocks


def _check_place(where: str, name: str, value: str) -> None:
    try:
        inside = abs(float(value)) <= _FARTHEST_UNITS
    except ValueError:
        inside = False
    if not inside:
        raise ValueError(f"{where} has {name} {value[:20]}; expected a number up to {_FARTHEST_UNITS:g}")


def _check_binary(found: dict[str, bytes]) -> None:
    hexen = "BEHAVIOR" in found
    counts = {}
    for name, sizes in _SIZES.items():
        size, data = sizes[hexen], found.get(name, b"")
        if not data or len(data) % size:
            raise ValueError(f"{name} has {len(data)} bytes; expected records of {size}")
        counts[name] = len(data) // size
    line = "<3H6B2H" if hexen else "<7H"
    for number, (first, second, *_, front, back) in enumerate(struct.iter_unpack(line, found["LINEDEFS"])):
        if max(first, second) >= counts["VERTEXES"]:
            raise ValueError(f"line {number} joins vertices {first} and {second}; there are {counts['VERTEXES']}")
        if front >= counts["SIDEDEFS"] or (back != _NO_SIDE and back >= counts["SIDEDEFS"]):
            raise ValueError(f"line {number} has the sides {front} and {back}; there are {counts['SIDEDEFS']}")
    for number, (*_, sector) in enumerate(struct.iter_unpack("<2h24sH", found["SIDEDEFS"])):
        if sector >= counts["SECTORS"]:
            raise ValueError(f"side {number} is of sector {sector}; there are {counts['SECTORS']}")
    thing = "<7H6B" if hexen else "<5H"
    kinds = {record[5 if hexen else 3] for record in struct.iter_unpack(thing, found["THINGS"])}
    if _PLAYER not in kinds:
        raise ValueError("it has no start of the player")
