"""One MCAP file, finished or cut off, as a source of serialised messages."""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, MessageIndex, Schema, Statistics
from mcap.stream_reader import read_magic
from mcap.summary import Summary

from ngo_recordings.bounds import MAX_CHUNK_BYTES, check_regular, unpacked
from ngo_recordings.definitions import ROS1_ENCODING, plain_definition, ros2_type
from ngo_recordings.errors import RecordingError

# What the library lets through when the bytes are not what they should be.
BROKEN = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ArithmeticError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    ValueError,
)
_MAGIC_SIZE = 8
_RECORD_HEAD = struct.Struct("<BQ")
_RECORD_HEAD_SIZE = _RECORD_HEAD.size
_FOOTER_SIZE = 29
_MESSAGE_HEAD = struct.Struct("<HIQQ")
# A chunk's record beyond what it holds: sizes, times, and the name of the compression.
_CHUNK_OVERHEAD = 2**16
# Chunks whose times overlap are held together, up to this many times the largest chunk.
_MAX_OVERLAP = 2


@dataclass
class Stored:
    """What a file holds of one topic; definition is empty where the file has none."""

    type_name: str
    definition: str
    encoding: str
    count: int = 0
    first_ns: int = 2**63 - 1
    last_ns: int = 0

    def add(self, log_time_ns: int) -> None:
        """Count one message."""
        self.count += 1
        self.first_ns, self.last_ns = min(self.first_ns, log_time_ns), max(self.last_ns, log_time_ns)


class McapFile:
    """One .mcap file; of one without an end, whose writer was killed, what is whole.

    Args:
        max_chunk_bytes: largest chunk, packed or not, and largest record that is read.

    Raises:
        RecordingError: the file is no MCAP file of ROS 2.
    """

    stamps_made = False

    def __init__(self, path: Path, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> None:
        check_regular(path)
        self.path = path
        self.notes: tuple[str, ...] = ()
        self._most = max_chunk_bytes
        self._stream = path.open("rb")
        self.unfinished = False
        self._chunked = True
        self.topics: dict[str, Stored] = {}
        self._damaged = ""
        self._foreign: dict[int, str] = {}  # by channel, why its messages cannot be read
        try:
            read_magic(ReadDataStream(self._stream))
            self._size = os.fstat(self._stream.fileno()).st_size
            self._summary = self._read_summary()
            self._collect_topics()
        except RecordingError:
            self._stream.close()
            raise
        except BROKEN as error:
            self._stream.close()
            raise RecordingError(f"{path} cannot be read as MCAP ({_reason(error)}): is it a recording?") from None

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def messages(self, names: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and CDR bytes of the messages of these topics, in order of log time.

        A file without chunks gives them in the order in which they were written.
        """
        # A stream of its own: several readers may run at a time.
        with self.path.open("rb") as stream:
            try:
                if self._chunked:
                    yield from self._from_chunks(stream, names)
                    return
                for position, opcode, length in self._whole_records(stream):
                    if opcode == Opcode.MESSAGE:
                        channel_id, log_time_ns, data = _message(self._record(stream, position, length))
                        topic = self._summary.channels[channel_id].topic
                        if topic in names and channel_id not in self._foreign:
                            yield topic, log_time_ns, bytes(data)
            except BROKEN as error:
                raise RecordingError(
                    f"{self.path} is damaged ({_reason(error)}): copy it again, or repair it with `mcap recover`"
                ) from None

    def _from_chunks(self, stream: IO[bytes], names: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Messages by the index of chunks, in order of log time; of equal times, as they were written."""
        topics = {number: channel.topic for number, channel in self._summary.channels.items()}
        wanted = {number for number, topic in topics.items() if topic in names and number not in self._foreign}
        chunks = sorted(
            (chunk for chunk in self._summary.chunk_indexes if _may_hold(chunk, wanted)),
            key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset),
            reverse=True,
        )
        waiting: list[tuple[int, int, int, str, bytes]] = []
        held = 0
        while chunks or waiting:
            while chunks and (not waiting or chunks[-1].message_start_time <= waiting[0][0]):
                start = chunks.pop().chunk_start_offset
                for order, (opcode, record) in enumerate(_records(self._unpacked(stream, start))):
                    if opcode == Opcode.MESSAGE:
                        channel_id, log_time_ns, data = _message(record)
                        if channel_id in wanted:
                            heapq.heappush(waiting, (log_time_ns, start, order, topics[channel_id], bytes(data)))
                            held += len(data)
                        elif channel_id not in topics:
                            raise ValueError(f"a message of channel {channel_id}, which is not in the file")
                if held > _MAX_OVERLAP * self._most:
                    raise ValueError(f"chunks overlap in time: more than {_MAX_OVERLAP * self._most} bytes at once")
            if waiting:
                log_time_ns, _, _, topic, message = heapq.heappop(waiting)
                held -= len(message)
                yield topic, log_time_ns, message

    def _unpacked(self, stream: IO[bytes], position: int) -> bytes:
        """What the chunk at a position holds; its declared and its real size are bounded."""
        stream.seek(position)
        opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD_SIZE))
        if opcode != Opcode.CHUNK:
            raise ValueError(f"no chunk at byte {position}")
        return self._chunk_data(self._chunk(stream, position, length + _RECORD_HEAD_SIZE))

    def _chunk(self, stream: IO[bytes], position: int, length: int) -> Chunk:
        return Chunk.read(ReadDataStream(BytesIO(self._record(stream, position, length))))

    def _chunk_data(self, chunk: Chunk) -> bytes:
        data = unpacked(chunk.data, chunk.compression, self._most, chunk.uncompressed_size)
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("the checksum of a chunk does not fit")
        return data

    def _record(self, stream: IO[bytes], position: int, length: int) -> bytes:
        """Bytes of a record without its head; length counts the head."""
        if length > self._most + _CHUNK_OVERHEAD:
            raise ValueError(f"a record of {length} bytes at byte {position}; expected at most {self._most}")
        stream.seek(position + _RECORD_HEAD_SIZE)
        record = stream.read(length - _RECORD_HEAD_SIZE)
        if len(record) != length - _RECORD_HEAD_SIZE:
            raise EOFError(f"the record at byte {position} is cut off")
        return record

    def _read_summary(self) -> Summary:
        """The file's own index, or one that is made by reading all of it."""
        end = self._size - _FOOTER_SIZE - _MAGIC_SIZE
        if end > _MAGIC_SIZE:
            self._stream.seek(-_MAGIC_SIZE, os.SEEK_END)
            try:
                read_magic(ReadDataStream(self._stream))
            except McapError:
                self.unfinished = True
            else:
                summary = self._own_summary(end)
                if summary is not None and summary.statistics is not None and _has_index(summary):
                    return summary
        else:
            self.unfinished = True
        return self._scan()

    def _own_summary(self, end: int) -> Summary | None:
        """The summary at the end of the file, where there is one."""
        self._stream.seek(end)
        opcode, length = _RECORD_HEAD.unpack(self._stream.read(_RECORD_HEAD_SIZE))
        if opcode != Opcode.FOOTER:
            raise ValueError("the file has no footer")
        footer = Footer.read(ReadDataStream(BytesIO(self._record(self._stream, end, length + _RECORD_HEAD_SIZE))))
        if not footer.summary_start:
            return None
        if not _MAGIC_SIZE <= footer.summary_start <= end:
            raise ValueError(f"the footer has the summary at byte {footer.summary_start}")
        summary = Summary()
        for position, kind, size in self._whole_records(self._stream, footer.summary_start):
            if kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX, Opcode.STATISTICS):
                self._collect(summary, kind, self._record(self._stream, position, size))
        return summary

    def _scan(self) -> Summary:
        """An index made by reading every record that is whole; counts the messages of the topics on the way."""
        summary = Summary()
        self._chunked = False
        for position, opcode, length in self._whole_records(self._stream):
            if opcode == Opcode.CHUNK:
                self._chunked = True
                try:
                    summary.chunk_indexes.append(self._scan_chunk(summary, position, length))
                except RecordingError as error:
                    if not summary.chunk_indexes:
                        raise
                    self._damaged = self._damaged or f"{error}: this chunk is left out"
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                self._collect(summary, opcode, self._record(self._stream, position, length))
        return summary

    def _scan_chunk(self, summary: Summary, position: int, length: int) -> ChunkIndex:
        held: set[int] = set()
        try:
            chunk = self._chunk(self._stream, position, length)
            for opcode, record in _records(self._chunk_data(chunk)):
                self._collect(summary, opcode, record)
                if opcode == Opcode.MESSAGE:
                    held.add(_message(record)[0])
        except BROKEN as error:
            raise RecordingError(
                f"{self.path} is damaged at byte {position} ({_reason(error)}): repair it with `mcap recover`"
            ) from None
        return ChunkIndex(
            chunk_length=length,
            chunk_start_offset=position,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets=dict.fromkeys(held, 0),
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )

    def _collect(self, summary: Summary, opcode: int, record: bytes | memoryview) -> None:
        """Take one record into an index; messages are counted."""
        if opcode == Opcode.MESSAGE:
            channel_id, log_time_ns, _ = _message(record)
            if (stored := self._stored(summary, channel_id)) is not None:
                stored.add(log_time_ns)
            return
        stream = ReadDataStream(BytesIO(record))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            summary.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            summary.channels[channel.id] = channel
        elif opcode == Opcode.CHUNK_INDEX:
            summary.chunk_indexes.append(ChunkIndex.read(stream))
        elif opcode == Opcode.STATISTICS:
            summary.statistics = Statistics.read(stream)

    def _whole_records(self, stream: IO[bytes], position: int = _MAGIC_SIZE) -> Iterator[tuple[int, int, int]]:
        """Position, opcode and length of every record from a position to the end of the data, or to the cut."""
        while position + _RECORD_HEAD_SIZE <= self._size:
            stream.seek(position)
            opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD_SIZE))
            length += _RECORD_HEAD_SIZE
            # A disk that lost its power leaves zeros.
            if opcode in (0, Opcode.FOOTER, Opcode.DATA_END) or position + length > self._size:
                return
            yield position, opcode, length
            position += length

    def _collect_topics(self) -> None:
        """Topics with their counts and times from the index, where they were not counted already."""
        summary = self._summary
        if not self.topics and summary.statistics is not None:
            counts = summary.statistics.channel_message_counts
            for channel_id in summary.channels:
                if counts.get(channel_id, 0) and (stored := self._stored(summary, channel_id)) is not None:
                    stored.count += counts[channel_id]
                    first_ns, last_ns = self._extent(channel_id)
                    stored.first_ns, stored.last_ns = min(stored.first_ns, first_ns), max(stored.last_ns, last_ns)
        for channel_id in summary.channels:  # topics without a message
            self._stored(summary, channel_id)
        if self._foreign and not self.topics:
            raise RecordingError(f"{self.path}: {next(iter(self._foreign.values()))}")
        # A topic that nobody uses is no reason to refuse the others.
        self.notes = tuple(f"{self.path.name}: {reason}: left out" for reason in dict.fromkeys(self._foreign.values()))
        self.notes += (self._damaged,) if self._damaged else ()
        if self.unfinished and not self.topics:
            self.notes = (f"{self.path.name} is cut off before its first chunk ends: nothing of it can be read",)

    def _extent(self, channel_id: int) -> tuple[int, int]:
        """First and last log time of a channel, from as few of the message indexes as that takes."""
        first_ns, last_ns = 2**63 - 1, 0
        chunks = [chunk for chunk in self._summary.chunk_indexes if channel_id in chunk.message_index_offsets]
        for chunk in sorted(chunks, key=lambda chunk: chunk.message_start_time):
            if chunk.message_start_time >= first_ns:
                break
            first_ns = min([first_ns, *self._times(chunk, channel_id)])
        for chunk in sorted(chunks, key=lambda chunk: -chunk.message_end_time):
            if chunk.message_end_time <= last_ns:
                break
            last_ns = max([last_ns, *self._times(chunk, channel_id)])
        return first_ns, last_ns

    def _times(self, chunk: ChunkIndex, channel_id: int) -> list[int]:
        position = chunk.message_index_offsets[channel_id]
        self._stream.seek(position)
        _, length = _RECORD_HEAD.unpack(self._stream.read(_RECORD_HEAD_SIZE))
        if length > self._most // 8:
            raise ValueError(f"a message index of {length} bytes at byte {position}")
        record = self._record(self._stream, position, length + _RECORD_HEAD_SIZE)
        return [log_time for log_time, _ in MessageIndex.read(ReadDataStream(BytesIO(record))).records]

    def _stored(self, summary: Summary, channel_id: int) -> Stored | None:
        """The topic of a channel; None where its messages are in an encoding that ROS 2 does not record."""
        channel = summary.channels[channel_id]
        schema = summary.schemas.get(channel.schema_id)
        of_ros1 = schema is not None and (channel.message_encoding, schema.encoding) == ("ros1", ROS1_ENCODING)
        if schema is None or (channel.message_encoding != "cdr" and not of_ros1):
            self._foreign[channel_id] = (
                f"messages of {channel.topic} are in {channel.message_encoding or 'no'} encoding"
                f"{'' if schema else ' without a definition'}; expected CDR with one, as ROS 2 records"
            )
            return None
        if channel.topic not in self.topics:
            name, text = schema.name, schema.data.decode()
            self.topics[channel.topic] = Stored(
                ros2_type(name) if of_ros1 else name, plain_definition(text) if of_ros1 else text, schema.encoding
            )
        return self.topics[channel.topic]


def _records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of the records of a chunk."""
    view, position = memoryview(data), 0
    while position < len(view):
        opcode, length = _RECORD_HEAD.unpack_from(view, position)
        position += _RECORD_HEAD_SIZE
        if position + length > len(view):
            raise EOFError(f"a record of {length} bytes is longer than its chunk")
        yield opcode, view[position : position + length]
        position += length


def _message(record: bytes | memoryview) -> tuple[int, int, bytes | memoryview]:
    """Channel, log time and data of a message."""
    channel_id, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(record)
    return channel_id, log_time_ns, record[_MESSAGE_HEAD.size :]


def _may_hold(chunk: ChunkIndex, channels: set[int]) -> bool:
    """Whether a chunk has messages of these channels; one without an index may."""
    return not chunk.message_index_offsets or not channels.isdisjoint(chunk.message_index_offsets)


def _has_index(summary: Summary) -> bool:
    """Whether every message can be found by it."""
    assert summary.statistics is not None
    indexed = any(chunk.message_index_offsets for chunk in summary.chunk_indexes)
    return indexed or not summary.statistics.message_count


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
