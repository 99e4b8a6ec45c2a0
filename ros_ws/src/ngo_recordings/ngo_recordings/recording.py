"""Reads recordings: MCAP files, finished or not, and rosbag2 folders, one or several as one stream of messages."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml

from ngo_recordings.decoding import Decoder
from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import McapFile
from ngo_recordings.rosbag_folder import RosbagFolder


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a recording; first_ns and last_ns are log times, 0 where it has no message."""

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

    def __init__(self, sources: Sequence[McapFile | RosbagFolder]) -> None:
        self._sources = [(source, Decoder(source.path, source.topics)) for source in sources]
        self.paths = tuple(source.path for source in sources)
        self.unfinished = tuple(source.path for source in sources if source.unfinished)
        self.topics: dict[str, TopicInfo] = {}
        for name in sorted({name for source in sources for name in source.topics}):
            stored = [source.topics[name] for source in sources if name in source.topics]
            if len(types := {part.type_name for part in stored}) > 1:
                raise RecordingError(
                    f"topic {name} is of several types ({', '.join(sorted(types))}): open these recordings apart"
                )
            full = [part for part in stored if part.count]
            self.topics[name] = TopicInfo(
                stored[0].type_name,
                sum(part.count for part in full),
                min((part.first_ns for part in full), default=0),
                max((part.last_ns for part in full), default=0),
            )

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close all files."""
        for source, _ in self._sources:
            source.close()

    def messages(self, names: Collection[str] | None = None) -> Iterator[Message]:
        """Every message of these topics (None: of all) in order of log time, read as they are asked for.

        Memory is bounded by a few chunks of each file, whatever the size. May be called again, and several at a time.

        Raises:
            RecordingError: no such topic, or a message that cannot be read.
        """
        wanted = set(self.topics if names is None else names)
        if missing := sorted(wanted - self.topics.keys()):
            raise RecordingError(
                f"there is no topic {missing[0]} in {_names(self.paths)}; it has {', '.join(self.topics) or 'none'}"
            )
        # Of equal times, the file that was named first comes first: the order does not depend on chance.
        streams = [_decoded(source, decoder, wanted) for source, decoder in self._sources]
        return heapq.merge(*streams, key=lambda message: message.log_time_ns)


def open_recording(paths: Sequence[Path]) -> Recording:
    """Open .mcap files and rosbag2 folders (mcap or sqlite3), several as one in order of log time.

    Raises:
        RecordingError: there is no such file, or it is no recording.
    """
    if not paths:
        raise RecordingError("no recording was given: name .mcap files or rosbag2 folders")
    with ExitStack() as opened:
        sources: list[McapFile | RosbagFolder] = []
        for path in paths:
            for source in _open_sources(Path(path)):
                opened.callback(source.close)
                sources.append(source)
        recording = Recording(sources)
        opened.pop_all()
    return recording


def _open_sources(path: Path) -> Iterator[McapFile | RosbagFolder]:
    if path.is_dir():
        yield from _open_folder(path)
    elif not path.exists():
        raise RecordingError(f"there is no file {path}")
    elif path.suffix == ".mcap":
        yield McapFile(path)
    elif path.suffix == ".db3":
        yield RosbagFolder(path)
    else:
        raise RecordingError(f"{path} is no recording: expected a .mcap or .db3 file, or the folder of a rosbag2")


def _open_folder(path: Path) -> Iterator[McapFile | RosbagFolder]:
    """A folder whose recorder was killed has no metadata.yaml, and then its files are taken as they are."""
    metadata = path / "metadata.yaml"
    if not metadata.exists():
        files = sorted(path.glob("*.mcap")) or sorted(path.glob("*.db3"))
        if not files:
            raise RecordingError(f"{path} is no recording: it has neither metadata.yaml nor .mcap or .db3 files")
        for file in files:
            yield McapFile(file) if file.suffix == ".mcap" else RosbagFolder(file)
        return
    try:
        facts = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
        plain_mcap = facts["storage_identifier"] == "mcap" and not facts.get("compression_format")
        names = [Path(name).name for name in facts["relative_file_paths"]]
    except (yaml.YAMLError, ValueError, KeyError, TypeError, AttributeError, OSError):
        raise RecordingError(
            f"{metadata} is not what rosbag2 writes: make it anew with `ros2 bag reindex {path}`"
        ) from None
    if not plain_mcap:
        yield RosbagFolder(path)
        return
    for name in names:
        if not (path / name).exists():
            raise RecordingError(f"{path} lacks {name}, which its metadata.yaml names: copy it, too")
        yield McapFile(path / name)


def _decoded(source: McapFile | RosbagFolder, decoder: Decoder, names: set[str]) -> Iterator[Message]:
    for topic, log_time_ns, data in source.messages(names & source.topics.keys()):
        yield Message(topic, log_time_ns, decoder.decode(topic, log_time_ns, data))


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(str(path) for path in paths)
