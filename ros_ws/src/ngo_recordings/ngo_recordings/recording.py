"""Reads recordings: MCAP files, rosbag2 folders, ROS 1 bags and CARMEN logs, one or several as one stream."""

from __future__ import annotations

import heapq
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml

from ngo_recordings.bounds import MAX_CHUNK_BYTES, check_regular, unpacked
from ngo_recordings.carmen_log import CarmenLog
from ngo_recordings.copied_file import (
    PACKED,
    CopiedFile,
    cut_database,
    database_with_log,
    has_log,
    kind_of,
    named_kind,
    packed_file,
)
from ngo_recordings.decoding import Decoder
from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import McapFile
from ngo_recordings.ros1_bag import Ros1Bag
from ngo_recordings.ros1_records import Ros1Records
from ngo_recordings.rosbag_folder import RosbagFolder
from ngo_recordings.stamps import stamp_as_recorded, stamp_fault

Source = McapFile | RosbagFolder | Ros1Bag | Ros1Records | CarmenLog | CopiedFile
_PACKED_MESSAGE = b"\x28\xb5\x2f\xfd"  # begins no message in CDR

_CARMEN = (".log", ".clf", ".log.gz", ".clf.gz")
_IN_FOLDERS = (".mcap", ".db3", PACKED)
_NUMBERED = re.compile(r"(.*_)(\d+)(\..*)")
_EMPTY = "has nothing in it: left out"
_OTHERS = "is not read: in a folder .mcap files count before .db3 files, and these before packed ones"
_KINDS = "a .mcap, .db3 or .bag file, a CARMEN log (.log, .clf, either with .gz), or the folder of a rosbag2"


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
    their last whole chunk or line. stamps_made: the files whose stamps were made from the order of their messages, for
    they have none. notes: what a person should know about the files, one sentence each with the file's name.
    """

    def __init__(self, sources: Sequence[Source], notes: Sequence[str] = ()) -> None:
        self._sources = [(source, Decoder(source.path, source.topics)) for source in sources]
        self.paths = tuple(source.path for source in sources)
        self.unfinished = tuple(source.path for source in sources if source.unfinished)
        self.stamps_made = tuple(source.path for source in sources if source.stamps_made)
        self.notes = (*notes, *(note for source in sources for note in source.notes))
        self._as_recorded: set[str] = set()
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

    def check_stamps(self, names: Iterable[str]) -> None:
        """Stamps of these topics that run as no clock does are from now on the times at which they were recorded."""
        for name in set(names) - self._as_recorded:
            if fault := stamp_fault(self.messages([name])):
                self._as_recorded.add(name)
                self.notes = (*self.notes, f"stamps of {name} {fault}: the times of the recording count")

    def spans_ns(self, name: str) -> list[tuple[int, int]]:
        """Log times of a topic's first and last message in each file that has any."""
        stored = [source.topics[name] for source, _ in self._sources if name in source.topics]
        return [(part.first_ns, part.last_ns) for part in stored if part.count]

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
        merged = streams[0] if len(streams) == 1 else heapq.merge(*streams, key=lambda message: message.log_time_ns)
        return self._stamped(merged) if wanted & self._as_recorded else merged

    def _stamped(self, messages: Iterator[Message]) -> Iterator[Message]:
        for message in messages:
            if message.topic in self._as_recorded:
                stamp_as_recorded(message)
            yield message

    def first(self, name: str) -> Message:
        """The first message of a topic. Raises RecordingError where there is none, whatever the file's index says."""
        for message in self.messages([name]):
            return message
        raise RecordingError(f"topic {name} has no message in {_names(self.paths)}: copy the recording again")


def open_recording(paths: Sequence[Path], max_chunk_bytes: int = MAX_CHUNK_BYTES) -> Recording:
    """Open recordings, several as one in order of log time.

    Taken are .mcap files, rosbag2 folders (mcap or sqlite3), ROS 1 bags (.bag) and CARMEN logs (.log, .clf, .log.gz,
    .clf.gz). What a file begins with counts before its name.

    Args:
        max_chunk_bytes: largest chunk of MCAP files and ROS 1 bags that is unpacked; memory is up to six times this.

    Raises:
        RecordingError: there is no such file, or it is no recording.
    """
    if not paths:
        raise RecordingError(f"no recording was given: name {_KINDS}")
    with ExitStack() as opened:
        sources: list[Source] = []
        notes: list[str] = []
        for path in paths:
            for source in _open_sources(Path(path), max_chunk_bytes, notes):
                opened.callback(source.close)
                sources.append(source)
        recording = Recording(sources, notes)
        opened.pop_all()
    return recording


def _open_sources(path: Path, max_chunk_bytes: int, notes: list[str]) -> Iterator[Source]:
    if path.is_dir():
        yield from _open_folder(path, max_chunk_bytes, notes)
        return
    check_regular(path)
    kind = kind_of(path)
    if kind == ".mcap":
        yield McapFile(path, max_chunk_bytes)
    elif kind == ".db3":
        yield _database(path, max_chunk_bytes)
    elif kind == ".bag":
        yield _ros1_bag(path, max_chunk_bytes)
    elif kind == PACKED:
        yield packed_file(path, max_chunk_bytes)
    elif path.name.lower().endswith(_CARMEN):
        yield CarmenLog(path)
    else:
        raise RecordingError(f"{path} is no recording: expected {_KINDS}")


def _database(path: Path, max_chunk_bytes: int) -> Source:
    if has_log(path):
        return database_with_log(path, max_chunk_bytes)
    try:
        return RosbagFolder(path)
    except RecordingError as error:
        with suppress(RecordingError):
            return cut_database(path, max_chunk_bytes)
        raise error


def _ros1_bag(path: Path, max_chunk_bytes: int) -> Source:
    """By its index, where it has one that can be used."""
    try:
        return Ros1Bag(path, max_chunk_bytes)
    except RecordingError as error:
        try:
            return Ros1Records(path, max_chunk_bytes)
        except RecordingError:
            raise error from None


def _open_folder(path: Path, max_chunk_bytes: int, notes: list[str]) -> Iterator[Source]:
    """A folder whose recorder was killed has no metadata.yaml, or a cut one: its files are taken as they are."""
    metadata = path / "metadata.yaml"
    if not metadata.exists():
        yield from _open_files(path, path.iterdir(), max_chunk_bytes, notes)
        return
    check_regular(metadata)
    try:
        facts = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
        plain_mcap = facts["storage_identifier"] == "mcap" and not facts.get("compression_format")
        names = [Path(name).name for name in facts["relative_file_paths"]]
    except (yaml.YAMLError, ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError):
        notes.append(f"{metadata} is not what rosbag2 writes: the files beside it are read as they are")
        yield from _open_files(path, path.iterdir(), max_chunk_bytes, notes)
        return
    if later := _later(path, names):
        notes.append(f"metadata.yaml of {path} does not name {', '.join(later)}, which follow: they are read, too")
        names += later
    if missing := [name for name in names if not (path / name).exists()]:
        notes.append(f"{path} lacks {', '.join(missing)}, which its metadata.yaml names: what is there is read")
        named = [path / name for name in names if name not in missing]
        useful = any(file.stat().st_size for file in named)
        yield from _open_files(path, named if useful else path.iterdir(), max_chunk_bytes, notes)
        return
    if later:
        yield from _open_files(path, [path / name for name in names], max_chunk_bytes, notes)
        return
    if not plain_mcap:
        for name in names:
            check_regular(path / name)
        if any(has_log(path / name) for name in names):
            for name in names:
                yield _database(path / name, max_chunk_bytes)
            return
        try:
            whole = RosbagFolder(path)
        except RecordingError as error:
            notes.append(f"{error}: its files are read one by one")
            yield from _open_files(path, [path / name for name in names], max_chunk_bytes, notes)
        else:
            yield whole
        return
    for name in names:
        yield McapFile(path / name, max_chunk_bytes)


def _later(path: Path, names: list[str]) -> list[str]:
    """The files of a folder that follow those that its metadata.yaml names: their recorder was killed."""
    newest = {match.group(1, 3): int(match[2]) for name in names if (match := _NUMBERED.fullmatch(name))}
    found = [match for file in path.iterdir() if (match := _NUMBERED.fullmatch(file.name))]
    later = [match for match in found if int(match[2]) > newest.get(match.group(1, 3), math.inf)]
    return [match[0] for match in sorted(later, key=lambda match: int(match[2]))]


def _open_files(path: Path, files: Iterable[Path], max_chunk_bytes: int, notes: list[str]) -> Iterator[Source]:
    """Those of a folder's files that are recordings of one kind by their names; without any, by what they begin with.

    Recordings that are empty or of another kind are named.
    """
    files = sorted(file for file in files if file.is_file())
    full = [file for file in files if file.stat().st_size]
    kinds = _by_kind(full, named_kind) or _by_kind(full, kind_of)
    if not kinds:
        raise RecordingError(f"{path} is no recording: it has no .mcap or .db3 files")
    empty = [file.name for file in files if named_kind(file) in _IN_FOLDERS and file not in full]
    others = [file.name for of_a_kind in kinds[1:] for file in of_a_kind]
    notes += [f"{', '.join(names)} in {path} {why}" for names, why in ((empty, _EMPTY), (others, _OTHERS)) if names]
    for file in kinds[0]:
        yield from _open_sources(file, max_chunk_bytes, notes)


def _by_kind(files: Sequence[Path], kind_of_file: Callable[[Path], str]) -> list[list[Path]]:
    """Those of each kind that a folder may hold, the kind first that is read."""
    return [found for kind in _IN_FOLDERS if (found := [file for file in files if kind_of_file(file) == kind])]


def _decoded(source: Source, decoder: Decoder, names: set[str]) -> Iterator[Message]:
    for topic, log_time_ns, stored in source.messages(names & source.topics.keys()):
        # A recording that packs each message says so in its metadata.yaml alone, which may be lost.
        packed = isinstance(stored, bytes) and stored[:4] == _PACKED_MESSAGE
        try:
            data = unpacked(stored, "zstd", MAX_CHUNK_BYTES) if packed else stored
        except ValueError as error:
            raise RecordingError(f"{source.path} is damaged ({error}): copy it again") from None
        yield Message(topic, log_time_ns, decoder.decode(topic, log_time_ns, data))


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(str(path) for path in paths)
