"""Loops of 2D lidar key scans, with the evidence for each."""

from dataclasses import dataclass

import numpy as np

EVIDENCE = ("response", "second_peak", "on_lines", "seen_through", "disagreement", "agreeing")
"""Columns of a loop's evidence.

The mean likelihood of the points (0 to 1), the second peak's share of it, the share of points on lines, the share of
sightings through walls, the distance from the graph's pose in deviations (a third of the window), and the number of
neighbouring loops that agree.
"""


@dataclass(frozen=True)
class ScanLoops:
    """Loops between key scans.

    Attributes:
        pairs: indices of the keys ``(e, 2)``, the earlier first.
        relative: pose of the later in the earlier ``(e, 3)`` (m, m, rad).
        covariance: of these poses ``(e, 3, 3)``, along the axes of the earlier.
        evidence: ``(e, 6)``, columns as named in ``EVIDENCE``.
        accepted: whether to believe each ``(e,)``.
    """

    pairs: np.ndarray
    relative: np.ndarray
    covariance: np.ndarray
    evidence: np.ndarray
    accepted: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.pairs)
        shapes = tuple(x.shape for x in (self.pairs, self.relative, self.covariance, self.evidence, self.accepted))
        if shapes != ((count, 2), (count, 3), (count, 3, 3), (count, len(EVIDENCE)), (count,)):
            raise ValueError(f"the arrays of loops have the shapes {shapes}; expected e rows of 2, 3, 3 x 3, 6 and 1")

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, rows: np.ndarray | slice) -> "ScanLoops":
        """Some of the loops."""
        return ScanLoops(
            self.pairs[rows], self.relative[rows], self.covariance[rows], self.evidence[rows], self.accepted[rows]
        )

    @property
    def agreeing(self) -> np.ndarray:
        """How many neighbouring loops agree with each ``(e,)``."""
        return self.evidence[:, EVIDENCE.index("agreeing")]

    @staticmethod
    def none() -> "ScanLoops":
        """No loops."""
        return ScanLoops(
            np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, len(EVIDENCE))),
            np.zeros(0, bool),
        )  # fmt: skip

    def extended(self, others: "ScanLoops") -> "ScanLoops":
        """These loops, then the others."""
        return ScanLoops(
            np.concatenate((self.pairs, others.pairs)),
            np.concatenate((self.relative, others.relative)),
            np.concatenate((self.covariance, others.covariance)),
            np.concatenate((self.evidence, others.evidence)),
            np.concatenate((self.accepted, others.accepted)),
        )
