"""Bounds on what one file may cost: regular files alone, and no more bytes out of a chunk than it may hold."""

from __future__ import annotations

import bz2
import stat
from pathlib import Path

from ngo_recordings.errors import RecordingError

MAX_CHUNK_BYTES = 64 * 2**20
"""Largest chunk that is unpacked. Reading a file keeps below 500 MB of memory with it."""

_MAX_WINDOW_BYTES = 2**27


def check_regular(path: Path) -> None:
    """Refuse what is no regular file: opening a pipe would block for ever.

    Raises RecordingError where there is no file, or one of another kind.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        raise RecordingError(f"there is no file {path}") from None
    if not stat.S_ISREG(mode):
        raise RecordingError(f"{path} is no regular file (a folder, pipe, socket or device): expected a file on disk")


def unpacked(data: bytes, compression: str, most: int, declared: int | None = None) -> bytes:
    """Bytes of a chunk that is packed with zstd, lz4, bz2, or nothing ("" or "none").

    Args:
        most: largest size that is allowed, bytes.
        declared: the size that the file says, where it says one; it must be true.

    Raises:
        ValueError: the chunk is larger than most, of another size than declared, or packed in another way.
    """
    if declared is not None and declared > most:
        raise ValueError(f"a chunk of {declared} bytes; expected at most {most}")
    wanted = (most if declared is None else declared) + 1  # one more shows that there is more
    if compression == "zstd":
        import zstandard

        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
        with decompressor.stream_reader(data) as reader:
            found = reader.read(wanted)
    elif compression == "lz4":
        import lz4.frame

        found = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=wanted)
    elif compression == "bz2":
        found = bz2.BZ2Decompressor().decompress(data, max_length=wanted)
    elif compression in ("", "none"):
        found = data
    else:
        raise ValueError(f"a chunk packed with {compression!r}; expected zstd, lz4, bz2 or none")
    if declared is not None and len(found) != declared:
        more = "more than " if len(found) == wanted else ""
        raise ValueError(f"a chunk declares {declared} bytes and holds {more}{min(len(found), wanted - 1)}")
    if len(found) > most:
        raise ValueError(f"a chunk holds more than {most} bytes, which is the most that is read")
    return bytes(found)
