"""The resident part of large libraries, most of which a node needs while it starts, and never again."""

import ctypes
import mmap
import re
from pathlib import Path

_MAPS = Path("/proc/self/smaps")
_MAPPING = re.compile(
    r"^([0-9a-f]+)-([0-9a-f]+) r-[-x]p .*/(?:libllvmlite|libtorch_)[^/]*\n(?:[A-Z].*\n)*?Anonymous: +0 kB$", re.M
)


def release_code() -> None:
    """Take code and constants of torch and of numba's compiler out of the resident memory (150 MB).

    Linux maps again what is used again: a fifth of it. Nothing is done where ``/proc/self/smaps`` does not exist.
    """
    if not _MAPS.exists():
        return
    libc = ctypes.CDLL(None)
    # Nothing but what is as it is in the file: no page was ever written to, as those with addresses in them are.
    for begin, end in _MAPPING.findall(_MAPS.read_text()):
        start, size = int(begin, 16), int(end, 16) - int(begin, 16)
        libc.madvise(ctypes.c_void_p(start), ctypes.c_size_t(size), mmap.MADV_DONTNEED)
