"""Files that must be made whole before they are read: packed ones, and databases whose writer was killed."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from ngo_recordings.bounds import check_regular
from ngo_recordings.errors import RecordingError
from ngo_recordings.mcap_file import McapFile
from ngo_recordings.rosbag_folder import RosbagFolder

PACKED = "packed"
_TABLES = ("schema", "metadata", "topics", "message_definitions", "messages")
_VALID_FOR = 92
"""Where a database's head says for which of its changes the size in it holds; else the size of the file counts."""
_PACKED_NAMES = (".db3.zstd", ".mcap.zstd", ".db3.zst", ".mcap.zst")

_MAGIC = {
    ".mcap": b"\x89MCAP",
    ".db3": b"SQLite format 3",
    ".bag": b"#ROS",
    PACKED: b"\x28\xb5\x2f\xfd",
}


class CopiedFile:
    """A recording that is read from a copy in a temporary folder, which goes with it.

    Raises RecordingError where the copy cannot be made or read.
    """

    def __init__(self, path: Path, name: str, fill: Callable[[Path], object], max_chunk_bytes: int, note: str) -> None:
        self.path = path
        self._folder = TemporaryDirectory(prefix="ngo_recording_")
        copy = Path(self._folder.name, name)
        try:
            fill(copy)
            if kind_of(copy) == ".mcap":
                self._file: McapFile | RosbagFolder = McapFile(copy, max_chunk_bytes)
            else:
                try:
                    self._file = RosbagFolder(copy)
                except RecordingError:
                    whole = Path(self._folder.name, "whole.db3")
                    _salvage(copy, whole)
                    self._file = RosbagFolder(whole)
                    note = f"{path.name} is cut off: what is whole is read{'; ' * bool(note)}{note}"
        except (OSError, TypeError, ValueError, sqlite3.Error, sqlite3.Warning, zstandard.ZstdError) as error:
            self._folder.cleanup()
            reason = " ".join(str(error).replace(str(copy), str(path)).split())
            raise RecordingError(f"{path} cannot be read: {reason}") from None
        self.topics = self._file.topics
        self.unfinished, self.stamps_made = self._file.unfinished, self._file.stamps_made
        self.notes = (*self._file.notes, note) if note else self._file.notes

    def close(self) -> None:
        """Close the copy, and remove it."""
        self._file.close()
        self._folder.cleanup()

    def messages(self, names: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and CDR bytes of the messages of these topics, in order of log time."""
        yield from self._file.messages(names)


def packed_file(path: Path, max_chunk_bytes: int) -> CopiedFile:
    """A packed .db3 or .mcap file, as without its metadata.yaml."""
    check_regular(path)

    def unpack(copy: Path) -> None:
        with path.open("rb") as packed, copy.open("wb") as whole:
            zstandard.ZstdDecompressor().copy_stream(packed, whole)

    return CopiedFile(path, path.stem, unpack, max_chunk_bytes, "")


def cut_database(path: Path, max_chunk_bytes: int) -> CopiedFile:
    """A .db3 file whose end is missing, up to the first page that is."""
    return CopiedFile(path, path.name, partial(shutil.copyfile, path), max_chunk_bytes, "")


def _salvage(torn: Path, whole: Path) -> None:
    """Copy what can be read of a database; the size that its head says counts no more. Writes to ``torn``, too."""
    with torn.open("r+b") as file:
        file.seek(_VALID_FOR)
        file.write(bytes(4))
    with closing(sqlite3.connect(torn)) as source, closing(sqlite3.connect(whole)) as target:
        known = dict(source.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall())
        for name in (table for table in _TABLES if table in known):
            target.execute(known[name])
            with suppress(sqlite3.Error, UnicodeDecodeError):
                for row in source.execute(f"SELECT * FROM {name}"):
                    target.execute(f"INSERT INTO {name} VALUES ({', '.join('?' * len(row))})", row)
        target.commit()


def kind_of(path: Path) -> str:
    """The kind of a file, by what it begins with, else by its name: ".mcap", ".db3", ".bag", PACKED, or its ending."""
    try:
        with path.open("rb") as file:
            begin = file.read(16)
    except OSError:
        begin = b""
    return next((kind for kind, magic in _MAGIC.items() if begin.startswith(magic)), named_kind(path))


def named_kind(path: Path) -> str:
    """The kind of a file by its name, in capitals or small letters."""
    name = path.name.lower()
    return PACKED if name.endswith(_PACKED_NAMES) else Path(name).suffix


def log_of(path: Path) -> Path:
    """The file beside a database that holds what its writer had not put into it yet."""
    return path.with_name(path.name + "-wal")


def has_log(path: Path) -> bool:
    """Whether a database has such a file, and there is something in it."""
    log = log_of(path)
    return log.is_file() and log.stat().st_size > 0


def database_with_log(path: Path, max_chunk_bytes: int) -> CopiedFile:
    """A .db3 file of a recorder that was killed, with what is in its log. The file itself stays as it is."""
    for each in (path, log_of(path)):
        check_regular(each)

    def merge(copy: Path) -> None:
        shutil.copyfile(path, copy)
        shutil.copyfile(log_of(path), log_of(copy))
        database = sqlite3.connect(copy)
        try:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.execute("PRAGMA journal_mode=DELETE")
        finally:
            database.close()

    note = f"{path.name} was not closed by its recorder: {log_of(path).name} holds its end, which is read, too"
    return CopiedFile(path, path.name, merge, max_chunk_bytes, note)
