"""One ROS 1 bag (format 2.0) as a source of serialised messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import decompressors

from ngo_recordings.bounds import MAX_CHUNK_BYTES, check_regular, unpacked
from ngo_recordings.definitions import ROS1_ENCODING, plain_definition, ros2_type
from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import BROKEN, Stored

_BROKEN = (ReaderError, AssertionError, AttributeError, TypeError, *BROKEN)


class Ros1Bag:
    """A finished .bag file, chunks packed with bz2, lz4 or not at all; types have the names that ROS 2 gives them.

    Args:
        max_chunk_bytes: largest chunk that is unpacked.

    Raises:
        RecordingError: the file is no ROS 1 bag, has no index or is damaged.
    """

    unfinished = False
    stamps_made = False
    notes: tuple[str, ...] = ()

    def __init__(self, path: Path, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> None:
        check_regular(path)
        self.path = path
        self.topics: dict[str, Stored] = {}
        try:
            self._reader = Reader(path)
            self._reader.open()
        except _BROKEN as error:
            raise RecordingError(
                f"{path} cannot be read as a ROS 1 bag ({_reason(error)}): one that was cut off is mended by "
                "`rosbag reindex`"
            ) from None
        try:
            self._bound_chunks(max_chunk_bytes)
            for connection in self._reader.connections:
                self._add(connection)
        except _BROKEN as error:
            self._reader.close()
            raise RecordingError(f"{path} cannot be read as a ROS 1 bag ({_reason(error)})") from None

    def close(self) -> None:
        """Close the file."""
        if self._reader.bio is not None:
            self._reader.close()

    def messages(self, names: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and ROS 1 bytes of the messages of these topics, in order of log time."""
        connections = [connection for connection in self._reader.connections if connection.topic in names]
        try:
            for connection, log_time_ns, data in self._reader.messages(connections) if connections else ():
                yield connection.topic, log_time_ns, data
        except _BROKEN as error:
            raise RecordingError(
                f"{self.path} is damaged ({_reason(error)}): copy it again, or mend it with `rosbag reindex`"
            ) from None

    def _bound_chunks(self, most: int) -> None:
        """Have the library unpack with a limit; it has none of its own."""
        size = self.path.stat().st_size
        names = {function: name for name, function in decompressors.items()}
        for position, chunk in self._reader.chunks.items():
            if chunk.datasize > most or chunk.datapos + chunk.datasize > size:
                raise RecordingError(
                    f"a chunk at byte {position} declares {chunk.datasize} bytes; expected at most {most}, and no more "
                    f"than the file has"
                )
            unpack: Callable[[bytes], bytes] = partial(unpacked, compression=names[chunk.decompressor], most=most)
            self._reader.chunks[position] = chunk._replace(decompressor=unpack)

    def _add(self, connection: Connection) -> None:
        type_name = ros2_type(connection.msgtype)
        definition = plain_definition(connection.msgdef.data)
        stored = self.topics.setdefault(connection.topic, Stored(type_name, definition, ROS1_ENCODING))
        if stored.type_name != type_name:
            raise RecordingError(f"topic {connection.topic} is {stored.type_name} and {type_name}: expected one type")
        times = self._reader.indexes[connection.id]
        if times:
            stored.count += len(times)
            stored.first_ns = min(stored.first_ns, times[0].time)
            stored.last_ns = max(stored.last_ns, times[-1].time)


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
