"""Where to look for loops of a key scan: earlier places near which the robot may be, and how wide to search there.

Not in the paper.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ngo_estimator.optimizer.shortest_ways import shortest_ways


@dataclass(frozen=True)
class WindowConfig:
    """How far a pose may be from where the graph has it.

    ``least_m`` and ``share`` of the graph's distance, at most ``most_m``; in heading ``least_deg`` and ``deg_per_m``,
    at most ``most_deg``. ``deviations`` of a covariance are searched where covariances are given, within the same
    limits.
    """

    least_m: float = 0.3
    share: float = 0.04
    most_m: float = 8.0
    least_deg: float = 8.0
    deg_per_m: float = 0.25
    most_deg: float = 45.0
    deviations: float = 3.0

    def __post_init__(self) -> None:
        if not (0.0 < self.least_m <= self.most_m < math.inf and 0.0 < self.least_deg <= self.most_deg <= 180.0):
            raise ValueError(
                f"least_m, most_m, least_deg, most_deg are {self.least_m}, {self.most_m}, {self.least_deg}, "
                f"{self.most_deg}; expected positive limits, least no larger than most, degrees at most 180"
            )
        if not (self.share >= 0.0 and self.deg_per_m >= 0.0 and self.deviations > 0.0):
            raise ValueError(
                f"share, deg_per_m, deviations are {self.share}, {self.deg_per_m}, {self.deviations}; expected two "
                "numbers from 0 on, and a positive one"
            )


def graph_distances(poses: np.ndarray, loops: np.ndarray, key: int) -> np.ndarray:
    """Length ``(keys,)`` of the shortest way through the graph from a key to each other (m).

    The ways lead along the chain of poses ``(keys, 3)``, and over loops ``(e, 2)`` between their keys.
    """
    chain = np.arange(len(poses) - 1)
    nodes = np.concatenate((np.stack((chain, chain + 1), axis=1), loops))
    lengths = np.linalg.norm(poses[nodes[:, 1], :2] - poses[nodes[:, 0], :2], axis=1)
    # A millimetre more: a loop between keys in one place has a length, too.
    distances: np.ndarray = shortest_ways(nodes, lengths + 1e-3, len(poses), key)
    return distances


def distance_windows(config: WindowConfig, distances: np.ndarray) -> np.ndarray:
    """Half widths ``(keys, 3)`` of the search (m, m, rad) after distances through the graph ``(keys,)``."""
    metres = np.minimum(config.least_m + config.share * distances, config.most_m)
    degrees = np.minimum(config.least_deg + config.deg_per_m * distances, config.most_deg)
    return np.stack((metres, metres, np.radians(degrees)), axis=-1)


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
