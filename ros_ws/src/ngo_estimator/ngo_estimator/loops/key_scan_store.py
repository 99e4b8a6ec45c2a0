"""Key scans in bounded memory: compact, and forgotten where many others show the same place."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np
from scipy.spatial import KDTree

from ngo_estimator.data.state_arrays import (
    Arrays,
    flat,
    part,
    require,
    split,
    taken,
    taken_indices,
    taken_integer,
    under,
)
from ngo_estimator.geometry.key_scan import KeyScan, no_scan

_NEAR_M, _NEAR_DEG = 1.0, 30.0
"""Key scans as near as that to each other show the same."""

_RUN = 15
"""Key scans in a row that are forgotten together: single ones would leave holes everywhere."""

_NOTHING = np.zeros(0)


class KeyScanStore(Sequence[KeyScan]):
    """All key scans in their order; a forgotten one is there as a scan without points."""

    def __init__(self) -> None:
        self._scans: list[KeyScan] = []
        self._compact = 0  # how many are, from the first on
        self._points = 0
        self._kept: set[int] = set()

    def __len__(self) -> int:
        return len(self._scans)

    @overload
    def __getitem__(self, index: int) -> KeyScan: ...

    @overload
    def __getitem__(self, index: slice) -> list[KeyScan]: ...

    def __getitem__(self, index: int | slice) -> KeyScan | list[KeyScan]:
        if isinstance(index, slice):
            return [_whole(scan) for scan in self._scans[index]]
        return _whole(self._scans[index])

    @property
    def kept(self) -> int:
        """Key scans that are not forgotten."""
        return len(self._kept)

    @property
    def points(self) -> int:
        """Points of all of them."""
        return self._points

    def append(self, scan: KeyScan) -> None:
        """Add the next key scan."""
        self._kept.add(len(self._scans))
        self._scans.append(scan)
        self._points += len(scan.points)

    def state(self) -> Arrays:
        """All key scans, for ``restore``: points of the compact ones as single floats, all of the others."""
        compact, whole = self._scans[: self._compact], self._scans[self._compact :]
        arrays: Arrays = {
            "stamps_ns": np.array([scan.stamp_ns for scan in self._scans], np.int64),
            "sensors": np.array([scan.sensor_xyyaw for scan in self._scans]).reshape(-1, 3),
            "max_ranges": np.array([scan.max_range for scan in self._scans], np.float64),
            "kept": np.array(sorted(self._kept), np.int64),
            "compact": np.array(self._compact),
        }
        for name, scans, dtype in (("old", compact, np.float32), ("new", whole, np.float64)):
            for field in ("points", "normals"):
                rows = [getattr(scan, field).astype(dtype, copy=False) for scan in scans]
                arrays |= under(f"{name}.{field}", flat(rows, np.zeros((0, 2), dtype)))
        for field in ("angles", "ranges"):
            arrays |= under(f"new.{field}", flat([getattr(scan, field) for scan in whole], _NOTHING))
        return arrays

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()``, in place of what is here; raises ``StateError``."""
        stamps_ns = taken(arrays, "stamps_ns", np.int64, -1)
        count = len(stamps_ns)
        own = taken(arrays, "sensors", np.float64, count, 3), taken(arrays, "max_ranges", np.float64, count)
        self._compact = taken_integer(arrays, "compact")
        points, normals = (
            split(part(arrays, f"old.{field}"), np.float32, 2) + split(part(arrays, f"new.{field}"), np.float64, 2)
            for field in ("points", "normals")
        )
        angles, ranges = (
            [_NOTHING] * self._compact + split(part(arrays, f"new.{field}"), np.float64)
            for field in ("angles", "ranges")
        )
        columns = stamps_ns.tolist(), points, normals, own[0], angles, ranges, own[1].tolist()
        require({len(column) for column in columns} == {count}, f"there are not {count} key scans")
        self._scans = [KeyScan(*row) for row in zip(*columns, strict=True)]
        self._points = sum(map(len, points))
        self._kept = set(taken_indices(arrays, "kept", count).tolist())

    def compact(self) -> None:
        """Drop the rays of all key scans so far, and keep points and normals as single floats, as messages do."""
        for k in range(self._compact, len(self._scans)):
            scan = self._scans[k]
            points: Any = scan.points.astype(np.float32)
            normals: Any = scan.normals.astype(np.float32)
            self._scans[k] = replace(scan, points=points, normals=normals, angles=_NOTHING, ranges=_NOTHING)
        self._compact = len(self._scans)

    def forget(self, count: int, poses: np.ndarray, newest: int) -> list[int]:
        """Forget about so many of the key scans at poses ``(keys, 3)`` where most others show the same place.

        The ``newest`` stay in any case. Returns which are gone.
        """
        old = np.array(sorted(k for k in self._kept if k < len(self._scans) - newest), np.int64)
        gone: list[int] = []
        for run in _most_redundant(poses, old, count):
            gone += run
        for k in gone:
            self._points -= len(self._scans[k].points)
            self._scans[k] = no_scan(self._scans[k].stamp_ns)
        self._kept.difference_update(gone)
        return gone


def _whole(scan: KeyScan) -> KeyScan:
    if scan.points.dtype == np.float64:
        return scan
    whole = copy.copy(scan)  # not a new one: nothing needs to be checked again
    object.__setattr__(whole, "points", scan.points.astype(np.float64))
    object.__setattr__(whole, "normals", scan.normals.astype(np.float64))
    return whole


def _most_redundant(poses: np.ndarray, keys: np.ndarray, count: int) -> list[list[int]]:
    """Runs of keys, at least ``count`` keys where there are as many: each shows what most keys of other runs show."""
    runs, row = np.unique(keys // _RUN, return_inverse=True)
    headings = _NEAR_M / (2.0 * math.sin(0.5 * math.radians(_NEAR_DEG)))
    yaw = poses[keys, 2]
    at = np.column_stack((poses[keys, :2], headings * np.cos(yaw), headings * np.sin(yaw)))
    pairs = KDTree(at).query_pairs(_NEAR_M, output_type="ndarray") if len(keys) else np.zeros((0, 2), np.int64)
    # Keys of one run that another shows.
    shown = np.zeros((len(runs), len(runs)))
    for here, there in ((0, 1), (1, 0)):
        both = np.unique(np.column_stack((pairs[:, here], row[pairs[:, there]])), axis=0)
        np.add.at(shown, (row[both[:, 0]], both[:, 1]), 1.0)
    np.fill_diagonal(shown, 0.0)
    size = np.bincount(row, minlength=len(runs)).astype(np.float64)
    share = shown.sum(1) / np.maximum(size, 1.0)
    chosen: list[list[int]] = []
    left = count
    while left > 0 and np.isfinite(share).any():
        run = int(np.argmax(np.where(np.isfinite(share), share, -np.inf)))
        chosen.append(keys[row == run].tolist())
        left -= len(chosen[-1])
        share -= shown[:, run] / np.maximum(size, 1.0)
        share[run] = -np.inf
    return chosen
