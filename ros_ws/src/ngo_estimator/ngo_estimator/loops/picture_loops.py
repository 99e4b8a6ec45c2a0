"""Loops of key pictures, with the evidence for each."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.loops.loop_record import LoopRecord, rows


@dataclass(frozen=True)
class PictureLoops(LoopRecord):
    """Loops between key pictures.

    ``covariance`` ``(n, 3, 3)`` of ``relative``, along the axes of the earlier; ``inliers`` ``(n,)`` are matches
    that agree.
    """

    covariance: np.ndarray = rows(np.float64, 3, 3)
    inliers: np.ndarray = rows(np.int64)
