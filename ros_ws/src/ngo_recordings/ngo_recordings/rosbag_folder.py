"""A rosbag2 folder with its metadata.yaml, or an sqlite3 file of one, as a source of serialised messages."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

import apsw
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError

from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import BROKEN, Stored

_BROKEN = (ReaderError, apsw.Error, AttributeError, TypeError, *BROKEN)
_ENCODINGS = {
    MessageDefinitionFormat.MSG: "ros2msg",
    MessageDefinitionFormat.IDL: "ros2idl",
    MessageDefinitionFormat.NONE: "",
}


class RosbagFolder:
    """What the rosbags library reads: sqlite3 files of any name, and folders of sqlite3 or compressed mcap files.

    Raises RecordingError where it cannot.
    """

    unfinished = False
    stamps_made = False
    notes: tuple[str, ...] = ()

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[str, Stored] = {}
        try:
            self._reader = Reader.STORAGE_PLUGINS["dir" if path.is_dir() else ".db3"](path)
            self._reader.open()
            for connection in self._reader.connections:
                self._add(connection)
        except _BROKEN as error:
            raise RecordingError(f"{path} cannot be read as a rosbag2 recording: {_reason(error)}") from None

    def close(self) -> None:
        """Close all files."""
        self._reader.close()

    def messages(self, names: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and CDR bytes of the messages of these topics, in order of log time."""
        connections = [connection for connection in self._reader.connections if connection.topic in names]
        try:
            for connection, log_time_ns, data in self._reader.messages(connections) if connections else ():
                yield connection.topic, log_time_ns, bytes(data)
        except _BROKEN as error:
            raise RecordingError(f"{self.path} is damaged ({_reason(error)}): copy it again") from None

    def _add(self, connection: Connection) -> None:
        stored = self.topics.setdefault(
            connection.topic,
            Stored(connection.msgtype, connection.msgdef.data, _ENCODINGS[connection.msgdef.format]),
        )
        if not connection.msgcount:
            return
        first = next(iter(self._reader.messages([connection])), None)
        if first is not None:
            stored.count += connection.msgcount
            stored.first_ns = min(stored.first_ns, first[1])
            stored.last_ns = max(stored.last_ns, self._last_ns(connection, first[1]))

    def _last_ns(self, connection: Connection, first_ns: int) -> int:
        """Log time of a topic's last message: looks for it in ever longer parts of the end."""
        end_ns, span_ns = self._reader.metadata.end_time, 10**9
        while True:
            start_ns = max(first_ns, end_ns - span_ns)
            times = [log_time_ns for _, log_time_ns, _ in self._reader.messages([connection], start=start_ns)]
            if times:
                return max(times)
            if start_ns == first_ns:
                return first_ns
            span_ns *= 4


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
