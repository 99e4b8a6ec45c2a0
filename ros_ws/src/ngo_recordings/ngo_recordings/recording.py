"""Reads recordings: MCAP files, finished or not, and rosbag2 folders, one or several as one stream of messages."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a recording; first_ns and last_ns are log times."""

    type_name: str
    count: int
    first_ns: int
    last_ns: int


@dataclass(frozen=True)
class Message:
    """One message; value has the fields of its definition as attributes, arrays of numbers as numpy arrays."""

    topic: str
    log_time_ns: int
    value: Any


class Recording:
    """One or several recordings as one, messages in order of log time. A context manager; made by open_recording.

    topics: what is in it, by name. unfinished: the files that have no end (their writer was killed), which are read to
    their last whole chunk.
    """

    topics: Mapping[str, TopicInfo]
    paths: tuple[Path, ...]
    unfinished: tuple[Path, ...]

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close all files."""
        raise NotImplementedError

    def messages(self, names: Collection[str] | None = None) -> Iterator[Message]:
        """Every message of these topics (None: of all) in order of log time, read as they are asked for.

        Memory is bounded by a few chunks, whatever the size. May be called again, and several at a time.

        Raises:
            RecordingError: no such topic, or a message that cannot be read.
        """
        raise NotImplementedError


def open_recording(paths: Sequence[Path]) -> Recording:
    """Open .mcap files and rosbag2 folders (mcap or sqlite3), several as one in order of log time.

    Raises:
        RecordingError: there is no such file, or it is no recording.
    """
    raise NotImplementedError
