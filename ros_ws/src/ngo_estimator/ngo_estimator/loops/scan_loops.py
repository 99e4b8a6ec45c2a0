"""Loops of 2D lidar key scans, with the evidence for each."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.loops.loop_record import LoopRecord, rows

EVIDENCE = ("response", "second_peak", "on_lines", "seen_through", "disagreement", "agreeing")
"""Columns of a loop's evidence.

The mean likelihood of the points (0 to 1), the ratio of the second peak to it, the inlier ratio (points on lines), the
share of sightings through walls, the distance from the graph's pose in deviations (a third of the window), and the
number of neighbouring loops that agree.
"""


@dataclass(frozen=True)
class ScanLoops(LoopRecord):
    """Loops between key scans.

    ``covariance`` ``(n, 3, 3)`` of ``relative``, along the axes of the earlier; ``evidence`` ``(n, 6)``, columns as
    named in ``EVIDENCE``; ``accepted`` ``(n,)``, whether to believe each.
    """

    covariance: np.ndarray = rows(np.float64, 3, 3)
    evidence: np.ndarray = rows(np.float64, len(EVIDENCE))
    accepted: np.ndarray = rows(np.bool_)

    @property
    def agreeing(self) -> np.ndarray:
        """How many neighbouring loops agree with each ``(n,)``."""
        return self.evidence[:, EVIDENCE.index("agreeing")]
