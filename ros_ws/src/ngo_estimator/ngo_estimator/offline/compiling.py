"""Says that the compiler is at work, where that takes long."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_SILENT_S = 5.0


@contextmanager
def compiling(say: Callable[[str], object]) -> Iterator[None]:
    """Around a warm-up: says what takes so long where it takes long, which is once after an installation."""
    line = "compiles, once after an installation: this takes from ten seconds to two minutes"
    said = threading.Timer(_SILENT_S, say, (line,))
    said.daemon = True
    said.start()
    try:
        yield
    finally:
        said.cancel()
