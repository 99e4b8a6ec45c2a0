"""What came of an input: taken, refused with one clear line, or a fault of ours."""

import resource
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType

LIMIT_S = 10.0  # An input that takes longer counts as a hang.


class Hang(BaseException):
    """An input took too long."""


@dataclass
class Outcomes:
    """Counts of what came of the inputs of one target, and an example of each fault."""

    counts: Counter[str] = field(default_factory=Counter)
    faults: dict[str, str] = field(default_factory=dict)
    slowest_s: float = 0.0

    def add(self, name: str, work: Callable[[], str | None], clean: tuple[type[Exception], ...]) -> None:
        """Do the work with one input; ``work`` returns the line with which it was refused, or None.

        clean: errors that are clear lines, if they have one line.
        """
        began = time.monotonic()
        kind, example = "taken", ""
        try:
            line = within_limit(work)
            if line is not None:
                kind, example = _judged(line)
        except clean as error:
            kind, example = _judged(str(error))
        except Hang:
            kind, example = "hang", traceback.format_exc()
        except Exception:
            kind, example = "traceback", traceback.format_exc()
        self.slowest_s = max(self.slowest_s, time.monotonic() - began)
        self.counts[kind] += 1
        if kind in ("hang", "traceback"):
            self.faults.setdefault(f"{name}: {example.strip().splitlines()[-1]}", example)

    def numbers(self) -> dict[str, float]:
        """Counts by kind, the slowest input in s, and the largest memory of this process in MB."""
        kinds = ("taken", "clean line", "traceback", "hang")
        memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        return {kind: self.counts[kind] for kind in kinds} | {"slowest s": self.slowest_s, "memory MB": memory_mb}


def _judged(line: str) -> tuple[str, str]:
    return (
        ("clean line", "") if line.strip() and "\n" not in line.strip() else ("traceback", f"no clear line: {line!r}")
    )


def within_limit(work: Callable[[], str | None]) -> str | None:
    """Do the work; raises ``Hang`` where it takes longer than LIMIT_S."""

    def late(_: int, frame: FrameType | None) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
    try:
        return work()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
