"""Where to look for loops of a key scan: earlier places near which the robot may be, and how wide to search there."""

import math
from collections.abc import Sequence

import numpy as np

from ngo_estimator.graph.shortest_paths import shortest_paths
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_settings import ScanLoopConfig, WindowConfig


def graph_distances(
    poses: np.ndarray, loops: np.ndarray, key: int, segments: Sequence[int] | np.ndarray = ()
) -> np.ndarray:
    """Length ``(keys,)`` of the shortest path through the graph from a key to each other (m); infinite without one.

    The paths lead along the chain of poses ``(keys, 3)``, but not over the steps to the first keys of ``segments``,
    and over loops ``(e, 2)`` between their keys.
    """
    chain = np.arange(len(poses) - 1)
    nodes = np.concatenate((np.stack((chain, chain + 1), axis=1), loops))
    lengths = np.linalg.norm(poses[nodes[:, 1], :2] - poses[nodes[:, 0], :2], axis=1)
    begin = np.asarray(segments, np.int64)
    lengths[begin[begin > 0] - 1] = math.inf
    # A millimetre more: a loop between keys in one place has a length, too.
    distances: np.ndarray = shortest_paths(nodes, lengths + 1e-3, len(poses), key)
    return distances


def distance_windows(config: WindowConfig, distances: np.ndarray) -> np.ndarray:
    """Half widths ``(keys, 3)`` of the search (m, m, rad) after distances through the graph ``(keys,)``.

    They are infinite where the distance is.
    """
    metres = np.minimum(config.least_m + config.share * distances, config.most_m)
    degrees = np.minimum(config.least_deg + config.deg_per_m * distances, config.most_deg)
    windows = np.stack((metres, metres, np.radians(degrees)), axis=-1)
    windows[np.isinf(distances)] = math.inf
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
