"""Whether places look alike here: a way is searched in itself, where the truth is known.

Two robots that have been in one room each cannot know whether it is the same room. A robot that has seen several rooms
knows whether rooms are alike here: the evidence for a claim is asked about places that are certainly others.
"""

from collections.abc import Sequence

import numpy as np

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.place_evidence import evidence_of, last_stretch
from ngo_estimator.loops.scan_settings import ScanLoopConfig
from ngo_estimator.loops.scan_submaps import laid_together
from ngo_estimator.slam.evidence import elsewhere
from ngo_estimator.slam.scan_matcher import ScanMatcher

_LOOKS = 24
"""Places of the way that are searched in it."""

_REACH_M = 2.0
"""How far a place is from the way."""

MOST_ALIKE = 0.1
"""Where a larger share of places is alike, what looks the same may be another place."""


def alike_share(
    keys: np.ndarray,
    scans: Sequence[KeyScan],
    views: KeyScanViews,
    poses: np.ndarray,
    config: ScanLoopConfig,
) -> float:
    """The share of places on a way for which the evidence would suffice at another place of the way, too.

    Args:
        keys: the way's key scans ``(n,)``, one after another, whose poses are sure of each other.
        scans, views, poses: of all key scans, poses ``(keys, 3)``.
    """
    before = config.source_keys - 1
    chosen = [scans[key] for key in keys.tolist()]
    if len(keys) <= before or not any(len(scan.points) for scan in chosen):
        return 0.0
    matcher = ScanMatcher(chosen, poses[keys], views.of_keys(keys.tolist()), config, _REACH_M)

    def is_alike(key: int) -> bool:
        source = slice(key - before, key + 1)
        seen = matcher.search(laid_together(scans[source], views.profiles[source], poses[source])).poses
        stretch = last_stretch(poses[: key + 1], int(keys[0]))
        since = se2.between(poses[key], poses[stretch])
        others = (se2.compose(pose, since) for pose in seen[elsewhere(seen, poses[key], matcher.place_m)])
        return any(
            evidence_of(scans, views, (stretch, at), (keys, poses[keys]), count_walls=True).suffices for at in others
        )

    looks = np.unique(np.linspace(keys[before], keys[-1], _LOOKS).astype(np.int64))
    return sum(map(is_alike, looks.tolist())) / len(looks)
