"""Files that are read where they are files, and written whole or not at all."""

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def read_file(path: Path) -> bytes:
    """The content of a file; raises ``OSError`` where it cannot be read, or is none: a pipe would block for ever."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.read_bytes()


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A file of the same name to write to, which becomes ``path`` at the end and is gone after an error."""
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
