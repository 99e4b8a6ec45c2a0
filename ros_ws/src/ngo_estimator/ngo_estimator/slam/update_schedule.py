"""The schedule of updates: when work is repeated, and how many parts of an update a step does."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ngo_estimator.ngo.meta_poses import OptimizedMetaPoses


@dataclass
class RunningOptimisation:
    """An optimisation in progress, of which so many ``parts`` were done.

    ``numbers`` are those of its loops. It ``runs_network``, or takes corrections that are known. It ``anneals`` if all
    loops are judged anew.
    """

    iterations: Iterator[OptimizedMetaPoses]
    numbers: np.ndarray
    runs_network: bool
    anneals: bool
    parts: int = 0
    result: OptimizedMetaPoses | None = None

    def advance(self) -> None:
        """Do the next part: an iteration. With the network its preparation comes first, as a part of its own."""
        if self.parts or not self.runs_network:
            self.result = next(self.iterations)
        self.parts += 1

    @property
    def done(self) -> bool:
        """Whether the result is the last one."""
        return self.result is not None and self.result.left == 0


def is_due(since: int, seen: int, every: int) -> bool:
    """Whether to repeat work that saw ``seen`` blocks, ``since`` blocks ago, and is due for each ``every``-th block.

    A short trajectory changes a lot with each block.
    """
    return since >= min(every, 1 + seen // 8)


def parts_now(least: int, left: int, steps_left: int, light: bool) -> int:
    """How many of the parts ``left`` a step does: ``least``, or more where ``steps_left`` would not do them all.

    Where iterations are ``light``, the last steps do several, as all parts before iterations are the heavier ones.
    """
    most = max(least, -(-left // steps_left))
    now = max(least, left - most * (steps_left - 1)) if light else most
    return min(now, left)
