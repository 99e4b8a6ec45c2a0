"""The resident code of large libraries, most of which a node needs while it starts, and never again."""

import ctypes
import mmap
from pathlib import Path

_MAPS = Path("/proc/self/maps")
_LIBRARIES = ("libllvmlite", "libtorch_")


def release_code() -> None:
    """Take the code of torch and of numba's compiler out of the resident memory (130 MB).

    Linux maps again what is called again: a fifth of it. Nothing is done where ``/proc/self/maps`` does not exist.
    """
    if not _MAPS.exists():
        return
    libc = ctypes.CDLL(None)
    for line in _MAPS.read_text().splitlines():
        span, permissions, _, _, _, *path = line.split(maxsplit=5)
        # Code alone: these pages are as they are in the file. Others may have been written to.
        if permissions == "r-xp" and path and Path(path[0]).name.startswith(_LIBRARIES):
            begin, end = (int(address, 16) for address in span.split("-"))
            libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), mmap.MADV_DONTNEED)
