"""What the last optimisation thinks of loops: how many it believes, doubts and refuses, and why it refuses one."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry.se2 import between
from ngo_estimator.graph.relative_poses import BELIEVED

REFUSED_BELOW = 0.1
"""Weight of a loop that is refused; up to ``BELIEVED``, and before it has one, it is doubted."""


@dataclass(frozen=True)
class LoopReport:
    """Counts of loops; ``newest_refused`` says how far the newest one that is refused is off, empty without any.

    The variances of steps and of loops were found to be ``scales`` times as large as stated; None before that.
    """

    believed: int
    doubted: int
    refused: int
    newest_refused: str
    scales: tuple[float, float] | None


def loop_report(
    pairs: np.ndarray,
    relative: np.ndarray,
    weights: np.ndarray,
    waiting: int,
    stamps_ns: np.ndarray,
    poses: np.ndarray,
    scales: tuple[float, float] | None,
) -> LoopReport:
    """The report of loops between frames ``pairs`` ``(n, 2)``.

    Args:
        relative: the later frame as it was seen from the earlier ``(n, 3)``.
        weights: of the last optimisation ``(n,)``.
        waiting: loops that it has not seen.
        stamps_ns: of all frames ``(frames,)``, and their poses ``(frames, 3)``.
        scales: see ``LoopReport``.
    """
    believed, refused = weights > BELIEVED, weights < REFUSED_BELOW
    words = ""
    if refused.any():
        rows = np.flatnonzero(refused)
        row = int(rows[pairs[rows, 1].argmax()])
        first, second = pairs[row]
        off = between(relative[row], between(poses[first], poses[second]))
        seconds = stamps_ns[pairs[row]] * 1e-9
        words = (
            f"from {seconds[0]:.3f} s to {seconds[1]:.3f} s: {np.hypot(off[0], off[1]):.3g} m and "
            f"{abs(np.degrees(off[2])):.3g} deg off what all others say"
        )
    counted = int(believed.sum()), int((~believed & ~refused).sum()) + waiting, int(refused.sum())
    return LoopReport(*counted, words, scales)
