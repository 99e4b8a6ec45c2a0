"""Where to look for loops of a key scan: earlier places near which the robot may be, and how wide to search there."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry.planar_motion import between
from ngo_estimator.graph.shortest_paths import shortest_paths
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_settings import ScanLoopConfig, WindowConfig


@dataclass(frozen=True)
class LoopCandidate:
    """A place, and where in it the last key is searched: ``centre`` plus and minus ``window``, both ``(3,)``. The last
    key is ``likely`` that near to its pose in the graph."""

    place: int
    centre: np.ndarray
    window: np.ndarray
    likely: np.ndarray


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


def loop_candidates(
    config: ScanLoopConfig, views: KeyScanViews, poses: np.ndarray, windows: np.ndarray
) -> list[LoopCandidate]:
    """Where to look for loops of the last key, best first; see ``ScanLoopFinder.find`` for what is given."""
    key = len(poses) - 1
    path = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))))
    last = int(np.searchsorted(path, path[-1] - config.least_gap_m)) - config.submap_keys // 2
    last = min(last, key - config.source_keys - config.submap_keys // 2)
    steps = range(0, max(0, last), config.place_step)
    places = [place for place in steps if windows[place, 0] < math.inf]
    if len(places) == 0:
        return []
    near = nearest_places(
        views.at(poses), poses, windows, places, reach_m=config.reach_m, apart=config.submap_keys,
        most=config.most_per_key,
    )  # fmt: skip
    wider = windows * (config.search_factor, config.search_factor, 1.0)
    return [LoopCandidate(place, between(poses[place], poses[key]), wider[place], windows[place]) for place in near]


def nearest_places(
    views: np.ndarray, poses: np.ndarray, windows: np.ndarray, places: Sequence[int], *, reach_m: float, apart: int,
    most: int,
) -> list[int]:  # fmt: skip
    """Up to ``most`` of the places at which the last key may look, best first.

    Args:
        views: the middle of each key's points in the map ``(keys, 2)``: scans that show the same have it in common.
        poses: of all keys ``(keys, 3)``.
        windows: half widths of the search around each key ``(keys, 3)``.
        places: the keys that may be chosen.
        reach_m: a place may be that far outside of the window, since a scan reaches farther than the robot.
        apart: least number of keys between two that are chosen.
    """
    at = np.asarray(places, np.int64)
    if len(at) == 0 or most < 1:
        return []
    away = np.linalg.norm(poses[at, :2] - poses[-1, :2], axis=1)
    difference = np.linalg.norm(views[at] - views[-1], axis=1)
    chosen: list[int] = []
    for k in np.argsort(difference + 0.5 * away, kind="stable"):
        if away[k] <= windows[at[k], 0] + reach_m and all(abs(int(at[k]) - c) >= apart for c in chosen):
            chosen.append(int(at[k]))
            if len(chosen) == most:
                break
    return chosen
