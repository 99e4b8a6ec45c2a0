"""Key scans laid together in the frame of one of them: submaps of the map, and the newest scans."""

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ngo_estimator.data.state_arrays import Arrays, flat, part, require, split, taken, under
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.branch_and_bound import PooledGrid, pooled_grid
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.line_map import LineMap, line_map_of_points
from ngo_estimator.loops.key_scan_views import within
from ngo_estimator.loops.scan_settings import ScanLoopConfig
from ngo_estimator.loops.walls_seen_through import PROFILE_BINS, PlacedScans, placed

SUBMAP_VARIANCE = np.diag((0.01**2, 0.01**2, math.radians(0.15) ** 2))
"""Of the submap's own keys against each other, which registration in it can't see."""

_PLACED_ROWS = {"points": (2,), "normals": (2,), "sensors": (3,), "profiles": (PROFILE_BINS,)}
"""Shape of a row in each array of ``PlacedScans``, all float64."""


@dataclass(frozen=True)
class Submap:
    """Scans around a key, in its frame: ``poses`` of its keys as they were when it was made; the lowest is ``first``.
    Those of the search for loops follow each other. Without any point there is no grid."""

    first: int
    poses: np.ndarray
    scans: PlacedScans
    lines: LineMap
    grid: PooledGrid | None


class ScanSubmaps:
    """The submaps that were asked for last, each around a key."""

    def __init__(self, config: ScanLoopConfig) -> None:
        self._config = config
        self._submaps: OrderedDict[int, Submap] = OrderedDict()

    def __len__(self) -> int:
        return len(self._submaps)

    def around(
        self,
        place: int,
        keys: np.ndarray,
        scans: Sequence[KeyScan],
        profiles: Sequence[np.ndarray],
        poses: np.ndarray,
    ) -> Submap:
        """The submap around a key, made of ``keys`` ``(n,)`` of all key scans, their range profiles and poses."""
        if place in self._submaps:
            self._submaps.move_to_end(place)
            return self._submaps[place]
        local, chosen = se2.between(poses[place], poses[keys]), keys.tolist()
        together = placed([scans[key] for key in chosen], [profiles[key] for key in chosen], local)
        submap = self._submaps[place] = self._made(chosen[0], local, together)
        if len(self._submaps) > self._config.most_submaps:
            self._submaps.popitem(last=False)
        return submap

    def renumber(self, number: np.ndarray) -> None:
        """Take that each key scan has another number ``(keys,)`` now, where those of a submap follow each other."""
        self._submaps = OrderedDict(
            (int(number[place]), replace(submap, first=int(number[submap.first])))
            for place, submap in self._submaps.items()
        )

    def _made(self, first: int, local: np.ndarray, together: PlacedScans) -> Submap:
        lines = line_map_of_points(together.points, together.normals)
        near = within(together.points, self._config.range_m)
        grid = pooled_grid(self._config.search, near) if len(near) else None
        return Submap(first, local, together, lines, grid)

    def state(self) -> Arrays:
        """All submaps, for ``restore``: their scans lie where the poses had them, and may be gone since."""
        submaps = list(self._submaps.values())
        places = [(place, submap.first) for place, submap in self._submaps.items()]
        arrays: Arrays = {
            "places": np.array(places, np.int64).reshape(-1, 2),
            **under("submaps.poses", flat([submap.poses for submap in submaps], np.zeros((0, 3)))),
        }
        for name, shape in _PLACED_ROWS.items():
            rows = [getattr(submap.scans, name) for submap in submaps]
            arrays |= under(f"submaps.{name}", flat(rows, np.zeros((0, *shape))))
        return arrays

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()``, in place of what is here; raises ``StateError``."""
        places = taken(arrays, "places", np.int64, -1, 2)
        poses = split(part(arrays, "submaps.poses"), np.float64, 3)
        columns = [split(part(arrays, f"submaps.{name}"), np.float64, *shape) for name, shape in _PLACED_ROWS.items()]
        require({len(parts) for parts in (poses, *columns)} == {len(places)}, f"there are not {len(places)} submaps")
        self._submaps = OrderedDict(
            (place, self._made(first, local, PlacedScans(*scans)))
            for (place, first), local, *scans in zip(places.tolist(), poses, *columns, strict=True)
        )


def around_in_time(place: int, count: int, most: int, segments: np.ndarray | None = None) -> np.ndarray:
    """Of ``count`` key scans up to ``most`` that follow each other around one, none of another segment."""
    borders = np.array((0, count)) if segments is None else np.append(segments, count)
    own = int(np.searchsorted(borders, place, side="right"))
    first = place - most // 2
    return np.arange(max(first, int(borders[own - 1])), min(first + most, int(borders[own])))


def laid_together(scans: Sequence[KeyScan], profiles: Sequence[np.ndarray], poses: np.ndarray) -> PlacedScans:
    """Scans at poses ``(scans, 3)``, in the frame of the last."""
    return placed(scans, profiles, se2.between(poses[-1], poses))
