"""How much a message of a definition may cost to decode, known before any of it is made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype

_MAX_DEPTH = 50
_MAX_FIXED_PARTS = 10_000
_MAX_PARTS = 1_000_000
_SIZES = {"bool": 1, "byte": 1, "char": 1, "octet": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4}
_SIZES |= {"uint32": 4, "float32": 4, "int64": 8, "uint64": 8, "float64": 8, "float128": 16, "string": 4}


class DefinitionCost:
    """Bounds for messages of one type.

    A message costs by its parts: messages and texts within it, each an object of its own. Parts in fixed number are
    bounded for the definition, and parts in lists by the number that the bytes of a message may hold.

    Args:
        types: definitions as rosbags parses them, by name.

    Raises:
        ValueError: the definition is cyclic, deeper than 50, of more than 10,000 fixed parts, or a list's elements
            take no bytes, so that no size of a message bounds it.
    """

    def __init__(self, types: Mapping[str, Any], type_name: str) -> None:
        self._types = types
        # Least bytes, and fixed parts, by type.
        self._known: dict[str, tuple[int, int]] = {}
        self._least_element: int | None = None
        self._measure(type_name, ())

    def check(self, size: int) -> None:
        """Refuse a message of size bytes that may hold too many parts. Raises ValueError."""
        if self._least_element is not None and size // self._least_element > _MAX_PARTS:
            raise ValueError(f"its lists may hold more than {_MAX_PARTS} parts")

    def _measure(self, name: str, above: tuple[str, ...]) -> tuple[int, int]:
        if name in self._known:
            return self._known[name]
        if name in above:
            raise ValueError(f"the definition is cyclic: {' > '.join((*above[above.index(name) :], name))}")
        if len(above) >= _MAX_DEPTH:
            raise ValueError(f"the definition is deeper than {_MAX_DEPTH}")
        least, parts = 0, 1
        for _, field in self._types[name][1]:
            field_least, field_parts = self._field(field, (*above, name))
            least, parts = least + field_least, parts + field_parts
            if parts > _MAX_FIXED_PARTS:
                raise ValueError(f"the definition has more than {_MAX_FIXED_PARTS} parts")
        self._known[name] = least, parts
        return least, parts

    def _field(self, field: Any, above: tuple[str, ...]) -> tuple[int, int]:
        """Least bytes and fixed parts of a field."""
        kind, value = field
        if kind == Nodetype.NAME:
            return self._measure(value, above)
        if kind == Nodetype.BASE:
            return _SIZES.get(value[0], 1), int(value[0] == "string")
        element, count = value
        least, parts = self._field(element, above)
        if kind == Nodetype.ARRAY:
            return least * count, parts * count
        if parts:  # lists of numbers are arrays at once
            if not least:
                raise ValueError("a list has elements without content")
            self._least_element = min(least, self._least_element or least)
        return 4, 0
