"""Where to look for loops of a key scan: earlier places near which the robot may be, and how wide to search there."""

import math

import numpy as np

from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_settings import ScanLoopConfig, WindowConfig


def covariance_windows(config: WindowConfig, covariance: np.ndarray) -> np.ndarray:
    """Half widths ``(keys, 3)`` of the search (m, m, rad) where the graph has these covariances ``(keys, 3, 3)``.

    They are infinite where a covariance is.
    """
    known = np.isfinite(covariance).all(axis=(1, 2))
    given = np.where(known[:, None, None], covariance, 0.0)
    deviations = np.sqrt((np.linalg.eigvalsh(given[:, :2, :2])[:, -1], given[:, 2, 2]))
    most = np.array(((config.most_m,), (math.radians(config.most_deg),)))
    least = np.array(((config.least_m,), (math.radians(config.least_deg),)))
    metres, turns = np.minimum(least + config.deviations * deviations, most)
    windows = np.stack((metres, metres, turns), axis=-1)
    windows[~known] = math.inf
    return windows


def loop_candidates(config: ScanLoopConfig, views: KeyScanViews, poses: np.ndarray, windows: np.ndarray) -> list[int]:
    """The places, as keys, where to look for loops of the last key, best first.

    Scans that show the same have the middle of their points in common. See ``ScanLoopFinder.find`` for what is given.
    """
    key = len(poses) - 1
    path = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))))
    last = int(np.searchsorted(path, path[-1] - config.least_gap_m)) - config.submap_keys // 2
    last = min(last, key - config.source_keys - config.submap_keys // 2)
    at = np.arange(0, max(0, last), config.place_step)
    at = at[windows[at, 0] < math.inf]
    if len(at) == 0:
        return []
    middles = views.at(poses)
    away = np.linalg.norm(poses[at, :2] - poses[-1, :2], axis=1)
    difference = np.linalg.norm(middles[at] - middles[-1], axis=1)
    reached = away <= windows[at, 0] + config.reach_m  # a scan reaches farther than the robot
    chosen: list[int] = []
    for k in np.argsort(difference + 0.5 * away, kind="stable"):
        if len(chosen) == config.most_per_key:
            break
        if reached[k] and all(abs(int(at[k]) - other) >= config.submap_keys for other in chosen):
            chosen.append(int(at[k]))
    return chosen
