"""Serialised messages as objects, by the definitions that the recording itself holds."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from ngo_recordings.carmen_log import ENCODING as OBJECTS
from ngo_recordings.definition_cost import DefinitionCost
from ngo_recordings.definitions import ROS1_ENCODING, message_definition
from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import Stored

_SEPARATOR = "=" * 80 + "\n"
_MAX_REASON = 300
_BROKEN = (
    SerdeError,
    TypesysError,
    struct.error,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    SyntaxError,
    TypeError,
    ValueError,
)


class Decoder:
    """Decodes the messages of one file. Definitions are read when the first message of a topic comes.

    Old sqlite3 files hold no definitions: then those of ROS 2 Jazzy count, and after them the packages on this machine.
    """

    def __init__(self, path: Path, topics: Mapping[str, Stored]) -> None:
        self._path = path
        self._topics = topics
        self._typestores: dict[str, tuple[Any, DefinitionCost]] = {}

    def decode(self, topic: str, log_time_ns: int, data: Any) -> Any:
        """The message as an object; data are its bytes, or the object where the file gives objects.

        Raises RecordingError where it is not what its definition says.
        """
        type_name, encoding = self._topics[topic].type_name, self._topics[topic].encoding
        if encoding == OBJECTS:
            return data
        if type_name not in self._typestores:
            self._typestores[type_name] = self._typestore(self._topics[topic])
        typestore, cost = self._typestores[type_name]
        try:
            cost.check(len(data))
            read = typestore.deserialize_ros1 if encoding == ROS1_ENCODING else typestore.deserialize_cdr
            return read(data, type_name)
        except _BROKEN as error:
            raise RecordingError(
                f"{self._path}: the message of {topic} at {log_time_ns / 1e9:.9f} s ({len(data)} bytes) cannot be read "
                f"as {type_name} ({_reason(error)}): leave out the topic, or record it again"
            ) from None

    def _typestore(self, stored: Stored) -> tuple[Any, DefinitionCost]:
        """A store of its own for every type: another type may hold another version of what it is made of."""
        try:
            if stored.encoding in ("ros2msg", ROS1_ENCODING):
                types = get_types_from_msg(stored.definition, stored.type_name)
            elif stored.encoding in ("ros2idl", "omgidl"):
                types = {}
                for part in stored.definition.split(_SEPARATOR):
                    # Each part begins with a line such as "IDL: package/msg/Name", where there are several.
                    text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
                    types.update(get_types_from_idl(text) if text.strip() else {})
            elif stored.encoding == "":
                jazzy = get_typestore(Stores.ROS2_JAZZY)
                if stored.type_name in jazzy.fielddefs:
                    return jazzy, DefinitionCost(jazzy.fielddefs, stored.type_name)
                types = get_types_from_msg(message_definition(stored.type_name), stored.type_name)
            else:
                raise RecordingError(
                    f"{self._path}: the definition of {stored.type_name} is in {stored.encoding!r}; expected ros2msg "
                    "or ros2idl"
                )
            typestore = get_typestore(Stores.EMPTY)
            # Before classes and code are made of it: a hostile definition makes too much of them.
            cost = DefinitionCost({**typestore.fielddefs, **types}, stored.type_name)
            typestore.register(types)
        except RecordingError:
            raise
        except _BROKEN as error:
            raise RecordingError(
                f"{self._path}: the definition of {stored.type_name} cannot be read ({_reason(error)})"
            ) from None
        return typestore, cost


def _reason(error: BaseException) -> str:
    """One short line: the library quotes whole definitions."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= _MAX_REASON else f"{text[:_MAX_REASON]} ..."
