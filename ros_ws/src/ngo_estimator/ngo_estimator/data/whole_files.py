"""Files that are written all together or not at all."""

import errno
import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path


def write_together(contents: Mapping[Path, Iterable[bytes]]) -> list[Path]:
    """Write all files beside their places, and move them there only when each is on the disk.

    Args:
        contents: the parts of each file, in folders that exist.

    Returns:
        The files written.

    Raises:
        OSError: a file cannot be written; those that were there before still are.
    """
    written: dict[Path, str] = {}
    try:
        for path, parts in contents.items():
            if path.is_dir():  # which would only show once the files before it have been moved
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            handle, written[path] = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
            with os.fdopen(handle, "wb") as file:
                file.writelines(parts)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(written[path], 0o644)  # mkstemp's own 0600 would hide the result from others
        for path in contents:
            os.replace(written[path], path)
            del written[path]
    except OSError as error:
        if error.errno is None:
            raise
        # It names the file beside the one that was asked for.
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        for left in written.values():
            os.unlink(left)
    return list(contents)
