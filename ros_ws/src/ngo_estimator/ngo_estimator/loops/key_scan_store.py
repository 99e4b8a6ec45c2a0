"""Key scans in little memory: compact, once the search for loops has seen them."""

import copy
from collections.abc import Sequence
from typing import Any, overload

import numpy as np

from ngo_estimator.data.state_arrays import (
    Arrays,
    flat,
    part,
    require,
    split,
    taken,
    taken_integer,
    under,
)
from ngo_estimator.geometry.key_scan import KeyScan

_NOTHING = np.zeros(0)


class KeyScanStore(Sequence[KeyScan]):
    """All key scans in their order."""

    def __init__(self) -> None:
        self._scans: list[KeyScan] = []
        self._compact = 0  # how many are, from the first on
        self._points = 0

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
    def points(self) -> int:
        """Points of all of them."""
        return self._points

    def append(self, scan: KeyScan) -> None:
        """Add the next key scan."""
        self._scans.append(scan)
        self._points += len(scan.points)

    def state(self) -> Arrays:
        """All key scans, for ``restore``: points of the compact ones as single floats, all of the others."""
        compact, whole = self._scans[: self._compact], self._scans[self._compact :]
        arrays: Arrays = {
            "stamps_ns": np.array([scan.stamp_ns for scan in self._scans], np.int64),
            "sensors": np.array([scan.sensor_xyyaw for scan in self._scans]).reshape(-1, 3),
            "max_ranges": np.array([scan.max_range for scan in self._scans], np.float64),
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

    def compact(self) -> None:
        """Drop the rays of all key scans so far, and keep points and normals as single floats, as messages do."""
        for k in range(self._compact, len(self._scans)):
            scan = self._scans[k]
            points, normals = scan.points.astype(np.float32), scan.normals.astype(np.float32)
            self._scans[k] = _with(scan, points=points, normals=normals, angles=_NOTHING, ranges=_NOTHING)
        self._compact = len(self._scans)

    def reorder(self, order: np.ndarray) -> None:
        """Have the key scans ``order`` ``(keys,)``, by their old numbers, in this order, and all of them compact."""
        self.compact()
        self._scans = [self._scans[key] for key in order.tolist()]

    def thin(self, keep: np.ndarray) -> None:
        """Let go of the key scans that are not among ``keep`` ``(keys,)``."""
        self._scans = [scan for scan, stays in zip(self._scans, keep.tolist(), strict=True) if stays]
        self._points, self._compact = sum(len(scan.points) for scan in self._scans), int(keep[: self._compact].sum())


def _whole(scan: KeyScan) -> KeyScan:
    if scan.points.dtype == np.float64:
        return scan
    return _with(scan, points=scan.points.astype(np.float64), normals=scan.normals.astype(np.float64))


def _with(scan: KeyScan, **parts: Any) -> KeyScan:
    other = copy.copy(scan)  # not a new one: nothing needs to be checked again
    for name, part_of_it in parts.items():
        object.__setattr__(other, name, part_of_it)
    return other
