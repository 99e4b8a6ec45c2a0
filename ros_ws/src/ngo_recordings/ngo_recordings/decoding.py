"""Serialised messages as objects, by the definitions that the recording itself holds."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from ngo_recordings.definitions import message_definition
from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import Stored

_SEPARATOR = "=" * 80 + "\n"
_BROKEN = (
    SerdeError,
    TypesysError,
    struct.error,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
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
        self._typestores: dict[str, Any] = {}

    def decode(self, topic: str, log_time_ns: int, cdr: bytes) -> Any:
        """The message as an object. Raises RecordingError where it is not what its definition says."""
        type_name = self._topics[topic].type_name
        if type_name not in self._typestores:
            self._typestores[type_name] = self._typestore(self._topics[topic])
        try:
            return self._typestores[type_name].deserialize_cdr(cdr, type_name)
        except _BROKEN as error:
            raise RecordingError(
                f"{self._path}: the message of {topic} at {log_time_ns / 1e9:.9f} s ({len(cdr)} bytes) cannot be read "
                f"as {type_name} ({' '.join(str(error).split())}): leave out the topic, or record it again"
            ) from None

    def _typestore(self, stored: Stored) -> Any:
        """A store of its own for every type: another type may hold another version of what it is made of."""
        try:
            if stored.encoding == "ros2msg":
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
                    return jazzy
                types = get_types_from_msg(message_definition(stored.type_name), stored.type_name)
            else:
                raise RecordingError(
                    f"{self._path}: the definition of {stored.type_name} is in {stored.encoding!r}; expected ros2msg "
                    "or ros2idl"
                )
            typestore = get_typestore(Stores.EMPTY)
            typestore.register(types)
        except RecordingError:
            raise
        except _BROKEN as error:
            raise RecordingError(
                f"{self._path}: the definition of {stored.type_name} cannot be read ({' '.join(str(error).split())})"
            ) from None
        return typestore
