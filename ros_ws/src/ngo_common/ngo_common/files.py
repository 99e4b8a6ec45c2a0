"""Files that are read where they are files, and written whole or not at all."""

import errno
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


def read_file(path: Path) -> bytes:
    """The content of a file; raises ``OSError`` where it cannot be read, or is none: a pipe would block for ever."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.read_bytes()


PARTIAL = ".partial"  # Ending of files that a crash left unfinished; their names are ``.NAME.ANYTHING.partial``.


def write_whole(path: Path, content: bytes | str | Iterable[bytes]) -> None:
    """Write one file, as ``write_together`` does."""
    write_together({path: content})


def write_together(contents: Mapping[Path, bytes | str | Iterable[bytes]]) -> list[Path]:
    """Write all files beside their places, and move them there only when each is on the disk.

    Args:
        contents: of each file, whole or in parts, in folders that exist.

    Returns:
        The files written.

    Raises:
        OSError: a file cannot be written; those that were there before still are.
    """
    written: dict[Path, str] = {}
    try:
        for path, given in contents.items():
            if path.is_dir():  # which would only show once the files before it have been moved
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            handle, written[path] = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=PARTIAL)
            with os.fdopen(handle, "wb") as file:
                content = given.encode() if isinstance(given, str) else given
                file.writelines([content] if isinstance(content, bytes) else content)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(written[path], 0o644)  # mkstemp's own 0600 would hide the result from others
        for path in contents:
            os.replace(written[path], path)
            del written[path]
        for folder in {path.parent for path in contents}:
            sync_names(folder)
    except OSError as error:
        if error.errno is None:
            raise
        # It names the file beside the one that was asked for.
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        for left in written.values():
            os.unlink(left)
    return list(contents)


def sync_names(folder: Path) -> None:
    """Make the names in a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A file of the same name for others to write to, which becomes ``path`` at the end and is gone after an error."""
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent, ignore_cleanup_errors=True) as folder:
        whole = Path(folder) / path.name
        yield whole
        os.replace(whole, path)


@contextmanager
def folder_whole(folder: Path) -> Iterator[Path]:
    """A new folder within ``folder``; its files move there at the end, in place of those of their names.

    After an error none of them does, and ``folder`` is as it was.
    """
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix=".unfinished_", dir=folder, ignore_cleanup_errors=True) as name:
            yield Path(name)
            for path in sorted(Path(name).rglob("*")):
                if path.is_file():
                    place = folder / path.relative_to(name)
                    place.parent.mkdir(exist_ok=True)
                    os.replace(path, place)
    finally:
        if made and not any(folder.iterdir()):
            folder.rmdir()
