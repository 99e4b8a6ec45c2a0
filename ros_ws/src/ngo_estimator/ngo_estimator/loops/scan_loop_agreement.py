"""Neighbouring loops of key scans that agree with each other: the more a loop would change, the more must agree."""

import math

import numpy as np

from ngo_estimator.geometry.se2 import between, compose, wrap
from ngo_estimator.loops.scan_loops import EVIDENCE, ScanLoops
from ngo_estimator.loops.scan_settings import ScanLoopConfig

_DISAGREEMENT, _AGREEING = EVIDENCE.index("disagreement"), EVIDENCE.index("agreeing")


def with_agreement(config: ScanLoopConfig, loops: ScanLoops, known: int, poses: np.ndarray) -> ScanLoops:
    """All loops, with the neighbours counted that agree with those after the first ``known``.

    A new loop and an old one near it count for each other. ``poses`` ``(keys, 3)`` lead from one loop to the other.
    """
    pairs, evidence = loops.pairs, loops.evidence.copy()
    for k in range(known, len(loops)):
        gap = np.abs(pairs[:known] - pairs[k])
        near = np.flatnonzero((gap <= config.neighbour_keys).all(1) & (gap[:, 1] > 0))
        if len(near) == 0:
            continue
        # The way from the earlier key of this loop over the other loop to this loop's later key.
        to_earlier = between(poses[pairs[k, 0]], poses[pairs[near, 0]])
        to_later = between(poses[pairs[near, 1]], poses[pairs[k, 1]])
        off = compose(compose(to_earlier, loops.relative[near]), to_later) - loops.relative[k]
        turn = np.abs(wrap(off[:, 2]))
        agree = near[
            (np.linalg.norm(off[:, :2], axis=1) <= config.agreement_m) & (turn <= math.radians(config.agreement_deg))
        ]
        evidence[agree, _AGREEING] += 1.0
        evidence[k, _AGREEING] += len(agree)
    accepted = evidence[:, _AGREEING] >= config.agreeing_per_deviation * evidence[:, _DISAGREEMENT]
    return ScanLoops(pairs, loops.relative, loops.covariance, evidence, accepted)
