"""Writes messages as they came over the wire into one MCAP file that every tool for ROS 2 reads."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType


class RecordingWriter:
    """One MCAP file of profile ros2: CDR messages, their real definitions, chunks compressed with zstd.

    What was written is on the file at most a second later, so a process that is killed leaves a file that is read to
    its last chunk. A path that ends in .mcap is the file itself; any other is a new folder in the layout of rosbag2,
    whose metadata.yaml `close` writes. Use it as a context manager.

    Raises:
        RecordingError: the folder exists and is not empty.
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path, chunk_bytes: int = 2**20, library: str = "ngo_recordings") -> None:
        raise NotImplementedError

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add_topic(self, topic: str, type_name: str, definition: str | None = None) -> None:
        """Announce a topic before its first message.

        type_name: as in sensor_msgs/msg/Image. definition: text of the type and of all it is made of (ros2msg); None:
        the one of the ROS packages on this machine.
        """
        raise NotImplementedError

    def write(self, topic: str, cdr: bytes, log_time_ns: int, publish_time_ns: int | None = None) -> None:
        """Write one serialised message; publish_time_ns is log_time_ns where it is not given."""
        raise NotImplementedError

    def flush_if_due(self) -> None:
        """Put what was written onto the file if the last time was a second ago; `write` does so, too."""
        raise NotImplementedError

    def close(self) -> None:
        """Write the index (and metadata.yaml) and close the file."""
        raise NotImplementedError


def message_definition(type_name: str) -> str:
    """Text of a message type and of all it is made of, from the ROS packages on this machine (AMENT_PREFIX_PATH).

    Raises RecordingError where no package has it.
    """
    raise NotImplementedError
