"""Evidence of a registered step."""

import math

import numpy as np

from ngo_estimator.frontend.lidar.motion_prior import Prediction
from ngo_estimator.geometry.planar_motion import Array, wrap
from ngo_estimator.geometry.scan_matching import Registration


def step_evidence(since_key: Array, found: Registration, prediction: Prediction, searched: bool, unsure: bool) -> Array:
    """Evidence ``(12,)``, columns as in ``STEP_EVIDENCE``, of a registered scan.

    ``since_key`` ``(3,)`` is its pose seen from the last key scan.
    """
    lines = found.information
    middle, half_gap = 0.5 * (lines[0, 0] + lines[1, 1]), math.hypot(0.5 * (lines[0, 0] - lines[1, 1]), lines[0, 1])
    off = found.pose - prediction.mean
    off[2] = wrap(off[2])
    disagreement = math.sqrt(float(off @ prediction.information @ off))
    expected = 0.5 * np.log10(prediction.covariance.diagonal())
    return np.array((
        found.share,
        -0.5 * math.log10(max(middle - half_gap, 0.0) + 1.0),
        -0.5 * math.log10(middle + half_gap + 1.0),
        -0.5 * math.log10(lines[2, 2] + 1.0),
        math.hypot(since_key[0], since_key[1]),
        abs(since_key[2]),
        math.log1p(disagreement),
        float(searched),
        float(unsure),
        float(prediction.by_wheels),
        float(max(expected[0], expected[1])),
        float(expected[2]),
    ))  # fmt: skip
