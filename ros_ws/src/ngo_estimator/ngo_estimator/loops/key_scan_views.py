"""What is kept of each key scan to find it again: how far it sees in each direction, and where it looks."""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import Arrays, part, require, taken, under
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.loops.walls_seen_through import PROFILE_BINS, range_profile

_NEAR_M = 10.0
"""Points up to there say where a scan looks."""


class KeyScanViews:
    """Range profile of each key scan, and the middle of its points in the robot's frame."""

    def __init__(self) -> None:
        self._profiles: list[np.ndarray] = []
        self._middles = GrowingRows((2,), np.float64)

    def __len__(self) -> int:
        return len(self._profiles)

    @property
    def profiles(self) -> Sequence[np.ndarray]:
        """Range profile ``(360,)`` of each."""
        return self._profiles

    def append(self, scan: KeyScan) -> None:
        """Add the next key scan."""
        self._profiles.append(_profile(scan))
        self._middles.append(_middle(scan.points))

    def thin(self, keep: np.ndarray) -> None:
        """Drop what is kept of the key scans that are not among ``keep`` ``(keys,)``."""
        self.reorder(np.flatnonzero(keep[: len(self)]))

    def reorder(self, keys: np.ndarray) -> None:
        """Have those of the key scans ``keys`` ``(n,)``, by their old numbers, in this order."""
        self._profiles = [self._profiles[key] for key in keys.tolist()]
        self._middles.set(self._middles.values[keys])

    def of_map(self, scans: Sequence[KeyScan]) -> "KeyScanViews":
        """Those of all key scans of a map, of which these are the first."""
        other = KeyScanViews()
        other._profiles = [*self._profiles, *map(_profile, scans[len(self) :])]  # rays of old scans are gone
        for middle in self._middles.values:
            other._middles.append(middle)
        for scan in scans[len(self) :]:
            other._middles.append(_middle(scan.points))
        return other

    def of_keys(self, keys: Sequence[int]) -> "KeyScanViews":
        """Those of some key scans."""
        other = KeyScanViews()
        other._profiles = [self._profiles[key] for key in keys]
        for key in keys:
            other._middles.append(self._middles.values[key])
        return other

    def at(self, poses: np.ndarray) -> np.ndarray:
        """Where the robot looks at poses ``(keys, 3)`` of all key scans: their middles ``(keys, 2)``, in the map."""
        return _placed(self._middles.values, poses)

    def most_alike(self, poses: np.ndarray, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """The key scans ``(keys,)``, those near a pose ``(3,)`` first that look where points ``(n, 2)`` from there are.

        A scanner does not see what is behind it. ``poses`` ``(keys, 3)`` are those of all key scans.
        """
        view = _placed(_middle(points)[None], pose[None])
        away = np.linalg.norm(poses[:, :2] - pose[:2], axis=1)
        difference = np.linalg.norm(_placed(self._middles.values, poses) - view, axis=1)
        order: np.ndarray = np.argsort(difference + 0.5 * away, kind="stable")
        return order

    def state(self) -> Arrays:
        """All that is kept, for ``restore``."""
        return {
            "profiles": np.array(self._profiles, np.float32).reshape(-1, PROFILE_BINS),
            **under("middles", self._middles.state()),
        }

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()``, in place of what is here; raises ``StateError``."""
        profiles = taken(arrays, "profiles", np.float32, -1, PROFILE_BINS)
        self._middles.restore(part(arrays, "middles"))
        require(len(self._middles) == len(profiles), f"there are not {len(profiles)} middles of key scans")
        self._profiles = list(profiles)


@njit(cache=True)
def one_a_cell(points: np.ndarray, side: float) -> np.ndarray:
    """The first of the points ``(n, 2)`` in each cell of a side (m), as ascending rows."""
    size = 16
    while size < 2 * len(points):
        size *= 2
    table, rows, count = np.full(size, -1, np.int64), np.empty(len(points), np.int64), 0
    for k in range(len(points)):
        x, y = math.floor(points[k, 0] / side), math.floor(points[k, 1] / side)
        slot = (x * 73856093 ^ y * 19349663) & (size - 1)
        while table[slot] >= 0:
            other = points[table[slot]]
            if math.floor(other[0] / side) == x and math.floor(other[1] / side) == y:
                break
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot], rows[count] = k, k
            count += 1
    return rows[:count].copy()


def within(points: np.ndarray, range_m: float) -> np.ndarray:
    """The points ``(n, 2)`` within a range of the origin."""
    near: np.ndarray = points[(points**2).sum(1) <= range_m**2]
    return near


def _profile(scan: KeyScan) -> np.ndarray:
    return range_profile(scan).astype(np.float32)  # as scans have them: nothing is lost


def _middle(points: np.ndarray) -> np.ndarray:
    """The middle ``(2,)`` of the points around a robot, in its frame."""
    near = within(points, _NEAR_M)
    return near.mean(0) if len(near) else np.zeros(2)


def _placed(middles: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Middles ``(n, 2)`` seen from poses ``(n, 3)``, in the map."""
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, :2] + np.stack(
        (cosine * middles[:, 0] - sine * middles[:, 1], sine * middles[:, 0] + cosine * middles[:, 1]), axis=1
    )
