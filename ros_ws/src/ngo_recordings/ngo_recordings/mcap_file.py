"""One MCAP file, finished or cut off, as a source of serialised messages."""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, MessageIndex, Schema
from mcap.stream_reader import breakup_chunk, read_magic
from mcap.summary import Summary

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
_RECORD_HEAD_SIZE = 9
_FOOTER_SIZE = 29


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

    Raises RecordingError where the file is no MCAP file of ROS 2.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stream = path.open("rb")
        self.unfinished = False
        self._chunked = True
        self.topics: dict[str, Stored] = {}
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
                    reader = _IndexedReader(stream, self._summary)
                    for _, channel, message in reader.iter_messages(topics=list(names)):
                        yield channel.topic, message.log_time, message.data
                    return
                for position, opcode, length in self._whole_records(stream):
                    if opcode == Opcode.MESSAGE:
                        stream.seek(position + _RECORD_HEAD_SIZE)
                        message = Message.read(ReadDataStream(stream), length - _RECORD_HEAD_SIZE)
                        topic = self._summary.channels[message.channel_id].topic
                        if topic in names:
                            yield topic, message.log_time, message.data
            except BROKEN as error:
                raise RecordingError(
                    f"{self.path} is damaged ({_reason(error)}): copy it again, or repair it with `mcap recover`"
                ) from None

    def _read_summary(self) -> Summary:
        """The file's own index, or one that is made by reading all of it."""
        end = self._size - _FOOTER_SIZE - _MAGIC_SIZE
        if end > _MAGIC_SIZE:
            self._stream.seek(-_MAGIC_SIZE, os.SEEK_END)
            try:
                read_magic(ReadDataStream(self._stream))
                summary = SeekingReader(self._rewound()).get_summary()
            except McapError:
                self.unfinished = True
            else:
                if summary is not None and summary.statistics is not None and _has_index(summary):
                    return summary
        else:
            self.unfinished = True
        return self._scan()

    def _rewound(self) -> IO[bytes]:
        self._stream.seek(0)
        return self._stream

    def _scan(self) -> Summary:
        """An index made by reading every record that is whole; counts the messages of the topics on the way."""
        summary = Summary()
        self._chunked = False
        for position, opcode, length in self._whole_records(self._stream):
            self._stream.seek(position + _RECORD_HEAD_SIZE)
            data = ReadDataStream(self._stream)
            if opcode == Opcode.CHUNK:
                self._chunked = True
                summary.chunk_indexes.append(self._scan_chunk(summary, Chunk.read(data), position, length))
            elif opcode == Opcode.SCHEMA:
                self._scan_record(summary, Schema.read(data))
            elif opcode == Opcode.CHANNEL:
                self._scan_record(summary, Channel.read(data))
            elif opcode == Opcode.MESSAGE:
                self._scan_record(summary, Message.read(data, length - _RECORD_HEAD_SIZE))
        return summary

    def _scan_chunk(self, summary: Summary, chunk: Chunk, position: int, length: int) -> ChunkIndex:
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except BROKEN as error:
            raise RecordingError(
                f"{self.path} is damaged at byte {position} ({_reason(error)}): repair it with `mcap recover`"
            ) from None
        for record in records:
            self._scan_record(summary, record)
        return ChunkIndex(
            chunk_length=length,
            chunk_start_offset=position,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={record.channel_id: 0 for record in records if isinstance(record, Message)},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )

    def _scan_record(self, summary: Summary, record: McapRecord) -> None:
        if isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, Message):
            self._stored(summary, record.channel_id).add(record.log_time)

    def _whole_records(self, stream: IO[bytes]) -> Iterator[tuple[int, int, int]]:
        """Position, opcode and length of every record before the end of the data, or before the cut."""
        position = _MAGIC_SIZE
        while position + _RECORD_HEAD_SIZE <= self._size:
            stream.seek(position)
            head = ReadDataStream(stream)
            opcode, length = head.read1(), head.read8() + _RECORD_HEAD_SIZE
            if opcode in (Opcode.FOOTER, Opcode.DATA_END) or position + length > self._size:
                return
            yield position, opcode, length
            position += length

    def _collect_topics(self) -> None:
        """Topics with their counts and times from the index, where they were not counted already."""
        summary = self._summary
        if not self.topics and summary.statistics is not None:
            counts = summary.statistics.channel_message_counts
            for channel_id in summary.channels:
                if counts.get(channel_id, 0):
                    stored = self._stored(summary, channel_id)
                    stored.count += counts[channel_id]
                    first_ns, last_ns = self._extent(channel_id)
                    stored.first_ns, stored.last_ns = min(stored.first_ns, first_ns), max(stored.last_ns, last_ns)
        for channel_id in summary.channels:  # topics without a message
            self._stored(summary, channel_id)

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
        self._stream.seek(chunk.message_index_offsets[channel_id] + _RECORD_HEAD_SIZE)
        return [log_time for log_time, _ in MessageIndex.read(ReadDataStream(self._stream)).records]

    def _stored(self, summary: Summary, channel_id: int) -> Stored:
        channel = summary.channels[channel_id]
        if channel.topic not in self.topics:
            schema = summary.schemas.get(channel.schema_id)
            if channel.message_encoding != "cdr" or schema is None:
                raise RecordingError(
                    f"{self.path}: messages of {channel.topic} are in {channel.message_encoding or 'no'} encoding"
                    f"{'' if schema else ' without a definition'}; expected CDR with one, as ROS 2 records"
                )
            self.topics[channel.topic] = Stored(schema.name, schema.data.decode(), schema.encoding)
        return self.topics[channel.topic]


class _IndexedReader(SeekingReader):
    """Reads by an index that need not be the file's own."""

    def __init__(self, stream: IO[bytes], summary: Summary) -> None:
        super().__init__(stream, validate_crcs=True)
        self._given = summary

    def get_summary(self) -> Summary:
        return self._given


def _has_index(summary: Summary) -> bool:
    """Whether every message can be found by it."""
    assert summary.statistics is not None
    indexed = any(chunk.message_index_offsets for chunk in summary.chunk_indexes)
    return indexed or not summary.statistics.message_count


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
