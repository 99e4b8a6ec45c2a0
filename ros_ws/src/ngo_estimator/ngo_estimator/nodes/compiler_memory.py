"""The memory of numba's compiler, which a node needs while compiled functions are loaded, and hardly ever again."""

import ctypes
import mmap
from pathlib import Path

_MAPS = Path("/proc/self/maps")
_LIBRARY = "libllvmlite"


def release_compiler() -> None:
    """Take LLVM's code (50 MB) out of the resident memory; Linux reads again what is called again.

    Nothing is done where ``/proc/self/maps`` does not exist.
    """
    if not _MAPS.exists():
        return
    libc = ctypes.CDLL(None)
    for line in _MAPS.read_text().splitlines():
        span, permissions, _, _, _, *path = line.split(maxsplit=5)
        # Code alone: these pages are as they are in the file. Others may have been written to.
        if permissions == "r-xp" and path and Path(path[0]).name.startswith(_LIBRARY):
            begin, end = (int(address, 16) for address in span.split("-"))
            libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), mmap.MADV_DONTNEED)
