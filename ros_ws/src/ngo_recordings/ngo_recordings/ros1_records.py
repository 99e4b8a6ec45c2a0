"""ROS 1 bags record by record, without their index: cut-off ones, those of 2010, and format 1.2.

Format: http://wiki.ros.org/Bags/Format/2.0 and 1.2. A record is a header of ``name=value`` fields and its data, each
behind its length.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import BinaryIO

from ngo_recordings.bounds import unpacked
from ngo_recordings.definitions import ROS1_ENCODING, plain_definition, ros2_type
from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import Stored

_MAGIC = {b"#ROSBAG V2.0\n": 2, b"#ROSRECORD V1.2\n": 1}
_DEFINITION, _MESSAGE, _CHUNK, _CONNECTION = 0x01, 0x02, 0x05, 0x07
_INDEX, _INDEX_ENTRY = 0x04, 12  # records of 2010 say 20 bytes an entry
_LARGEST_HEADER = 2**24


@dataclass(frozen=True)
class _Found:
    log_time_ns: int
    order: int
    topic: str
    at: tuple[int, int]  # of the chunk (-1: none) and of the data in it or in the file
    size: int


class Ros1Records:
    """A .bag file whose records are read one after the other; the last whole one ends it.

    Raises RecordingError where it is none.
    """

    stamps_made = False

    def __init__(self, path: Path, max_chunk_bytes: int) -> None:
        self.path, self._most = path, max_chunk_bytes
        self.topics: dict[str, Stored] = {}
        self.unfinished = False
        self._connections: dict[int, str] = {}
        self._index: list[_Found] = []
        with path.open("rb") as stream:
            version = _MAGIC.get(stream.readline(64))
            if version is None:
                raise RecordingError(f"{path} is no ROS 1 bag of format 2.0 or 1.2")
            try:
                self._scan(stream, -1)
            except (ValueError, KeyError, struct.error) as error:
                reason = " ".join(str(error).split())
                raise RecordingError(f"{path} is a ROS 1 bag, but damaged ({reason}): copy it again") from None
        if not self.topics:
            raise RecordingError(f"{path} is a ROS 1 bag without a whole message: copy it again")
        self._index.sort(key=lambda found: (found.log_time_ns, found.order))
        kind = "format 1.2" if version == 1 else "no index that can be used"
        self.notes: tuple[str, ...] = (f"{path.name} has {kind}: it was read record by record",)

    def close(self) -> None:
        """Nothing is open."""

    def messages(self, names: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and ROS 1 bytes of the messages of these topics, in order of log time."""
        held, chunk = -1, b""
        with self.path.open("rb") as stream:
            for found in self._index:
                if found.topic not in names:
                    continue
                begin, offset = found.at
                if begin < 0:
                    stream.seek(offset)
                    yield found.topic, found.log_time_ns, stream.read(found.size)
                    continue
                if begin != held:
                    stream.seek(begin)
                    held, chunk = begin, self._chunk(stream)
                yield found.topic, found.log_time_ns, chunk[offset : offset + found.size]

    def _chunk(self, stream: BinaryIO) -> bytes:
        fields, size, _ = _head(stream)
        return unpacked(stream.read(size), fields["compression"].decode(), self._most)

    def _scan(self, stream: BinaryIO, chunk: int) -> None:
        """Take all records of the file, or of what a chunk holds."""
        begin = stream.tell()
        end = stream.seek(0, SEEK_END)
        stream.seek(begin)
        while (begin := stream.tell()) < end:
            try:
                fields, size, at = _head(stream)
            except EOFError:
                self.unfinished |= chunk < 0
                return
            kind = fields.get("op", b"\0")[0]
            if kind == _INDEX and not _is_record(stream, at + size, end):
                size = _INDEX_ENTRY * int(struct.unpack("<I", fields["count"])[0])
            if at + size > end:
                self.unfinished |= chunk < 0
                return
            stream.seek(at)
            if kind == _CHUNK and chunk < 0:
                data = stream.read(size)
                self._scan(BytesIO(unpacked(data, fields["compression"].decode(), self._most)), begin)
            elif kind in (_CONNECTION, _DEFINITION):
                self._define(fields, stream.read(size))
            elif kind == _MESSAGE:
                self._add(fields, chunk, at, size)
                stream.seek(at + size)
            else:
                stream.seek(at + size)

    def _define(self, fields: dict[str, bytes], data: bytes) -> None:
        described = _fields(data) if data else fields  # format 1.2 has all in the header
        topic = "/" + fields["topic"].decode().strip("/")
        type_name = ros2_type(described["type"].decode())
        definition = described.get("message_definition", described.get("def", b"")).decode(errors="replace")
        self.topics.setdefault(topic, Stored(type_name, plain_definition(definition), ROS1_ENCODING))
        if "conn" in fields:
            self._connections[struct.unpack("<I", fields["conn"])[0]] = topic

    def _add(self, fields: dict[str, bytes], chunk: int, at: int, size: int) -> None:
        if "conn" in fields:
            topic = self._connections[struct.unpack("<I", fields["conn"])[0]]
            seconds, nanoseconds = struct.unpack("<II", fields["time"])
        else:
            topic = "/" + fields["topic"].decode().strip("/")
            seconds, nanoseconds = (struct.unpack("<I", fields[name])[0] for name in ("sec", "nsec"))
        log_time_ns = seconds * 1_000_000_000 + nanoseconds
        self.topics[topic].add(log_time_ns)
        self._index.append(_Found(log_time_ns, len(self._index), topic, (chunk, at), size))


def _head(stream: BinaryIO) -> tuple[dict[str, bytes], int, int]:
    """The fields of a record's header, the size of its data, and where they begin; raises EOFError at the end."""
    size = _length(stream)
    if size > _LARGEST_HEADER:
        raise ValueError(f"a header of {size} bytes at byte {stream.tell()}")
    header = stream.read(size)
    if len(header) < size:
        raise EOFError
    data_size = _length(stream)
    return _fields(header), data_size, stream.tell()


def _is_record(stream: BinaryIO, at: int, end: int) -> bool:
    """Whether a record begins at a byte, or the file ends there."""
    if at >= end:
        return at == end
    stream.seek(at)
    try:
        return "op" in _head(stream)[0]
    except (EOFError, ValueError):
        return False


def _length(stream: BinaryIO) -> int:
    data = stream.read(4)
    if len(data) < 4:
        raise EOFError
    return int(struct.unpack("<I", data)[0])


def _fields(data: bytes) -> dict[str, bytes]:
    found, at = {}, 0
    while at + 4 <= len(data):
        size = struct.unpack_from("<I", data, at)[0]
        name, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
        if not equals:
            raise ValueError(f"a field of {size} bytes without a name")
        found[name.decode()] = value
        at += 4 + size
    return found
