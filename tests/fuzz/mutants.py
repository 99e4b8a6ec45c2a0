"""Mutants of files, and messages of any type with values that nobody expects."""

import importlib
import random
import re
import struct
from typing import Any

_WORDS = (
    b"1e999",
    b"-1",
    b"nan",
    b"99999999999999999999",
    b"[" * 3000,
    b"{" * 3000,
    b"null",
    b"\0",
    b"\xff\xfe",
    b'""',
)
_LONGS = (0, 1, -1, 255, 2**15, 2**31 - 1, -(2**31), 2**32 - 1)
FLOATS = (
    0.0, -0.0, 1.0, -1.0, 0.1, 3.14, 1e-9, 1e-45, 1e-300, 1e4, 1e9, 1e30, 3e38, 1e154, 1e300, 1.7e308, -1e300,
    float("nan"), float("inf"), float("-inf"),
)  # fmt: skip
_TEXTS = (
    "", "map", "odom", "base_link", "laser", "rgb8", "mono8", "32FC1", "32FC4", "jpeg", "png", "\0", "ü" * 40,
    "x" * 5000, "~nosuchuser/a.tum", "../a.tum", "/etc/a.tum", "a.tum", "a.g2o", "configure", "path_rate_hz",
)  # fmt: skip
_LENGTHS = (0, 1, 2, 3, 6, 7, 9, 12, 36, 241, 360)
_INTEGERS = re.compile(r"(u?)int(8|16|32|64)")
_SEQUENCE = re.compile(r"sequence<(.+?)(?:, (\d+))?>")
_ARRAY = re.compile(r"(.+)\[(\d+)\]")


def mutant(content: bytes, rng: random.Random) -> bytes:
    """The content with one to twenty changes: other bytes, numbers or words, parts that are gone or come twice."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 5, 19))):
        at, other = rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)
        change = rng.randrange(7)
        if change < 2 and at < len(data):
            data[at] = rng.randrange(256)
        elif change == 2:
            packed = struct.pack(rng.choice("<>") + "q", rng.choice(_LONGS))
            data[at : at + 4] = packed[:4] if rng.random() < 0.5 else packed
        elif change == 3:
            del data[at : None if rng.random() < 0.3 else at + rng.randrange(1, 50)]
        elif change == 4:
            data[at:at] = data[other : other + rng.randrange(1, 200)]
        elif change == 5:
            data[at : at + rng.randrange(4)] = rng.choice(_WORDS)
        else:
            data[at:at] = rng.randbytes(rng.randrange(1, 9))
        if len(data) == 0:
            break
    return bytes(data)


def spoil(message: Any, rng: random.Random, share: float) -> Any:
    """Give a share of the fields of a ROS message, however deep, values that nobody expects; returns the message."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if hasattr(value, "get_fields_and_field_types"):
            spoil(value, rng, share)
        elif rng.random() < share:
            setattr(message, name, any_value(kind, rng))
    return message


def any_value(kind: str, rng: random.Random) -> Any:
    """A value that a field of this type can hold."""
    if kind == "boolean":
        return rng.random() < 0.5
    if kind in ("float", "double"):
        largest = 3.4e38 if kind == "float" else 1.8e308
        value = rng.choice(FLOATS) if rng.random() < 0.7 else rng.gauss(0.0, 1.0)
        return value if not abs(value) > largest or abs(value) == float("inf") else largest
    if match := _INTEGERS.fullmatch(kind):
        bits, signed = int(match.group(2)), not match.group(1)
        least, most = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        return rng.choice((least, most, 0, 1, 3, rng.randint(least, most)))
    if kind == "octet":
        return bytes((rng.randrange(256),))
    if kind == "string":
        return rng.choice(_TEXTS)
    if match := _ARRAY.fullmatch(kind):
        return [any_value(match.group(1), rng) for _ in range(int(match.group(2)))]
    if match := _SEQUENCE.fullmatch(kind):
        count = rng.choice(_LENGTHS) if match.group(2) is None else rng.randrange(int(match.group(2)) + 1)
        if "/" in match.group(1):
            count = min(count, 3)
        values = [any_value(match.group(1), rng) for _ in range(min(count, 3))]
        return (values * (count // 3 + 1))[:count] if values else []
    package, name = kind.split("/")
    return spoil(getattr(importlib.import_module(f"{package}.msg"), name)(), rng, 1.0)
