"""The last key scans at their poses, as lines to register to and as a field to search in."""

import math
from collections import deque

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry import branch_and_bound
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.likelihood_field import LikelihoodField, SearchConfig, draw, joined, likelihood_field
from ngo_estimator.geometry.line_map import LineMap, averaged_lines, line_map_of_points, line_squares
from ngo_estimator.geometry.planar_motion import Array, rotated, transformed, wrap

_REDRAWN_SCANS = 10
_REDRAWN_M = 5.0
"""The field is drawn anew after so many scans or metres; scans that left the submap stay in it until then."""


_ALL_ROUND_RAD = math.radians(345.0)
"""Between the first and the last ray."""

_WIDE_SCANS = 10
"""So many of the newest scans make the grid of wide searches."""


class LocalSubmap:
    """At most ``most_scans`` key scans in the odometry's frame; lines and field are made when first asked for."""

    def __init__(self, most_scans: int, search: SearchConfig) -> None:
        self._points: deque[Array] = deque(maxlen=most_scans)
        self._normals: deque[Array] = deque(maxlen=most_scans)
        self._squares: deque[NDArray[np.int64]] = deque(maxlen=most_scans)
        self._poses: deque[Array] = deque(maxlen=most_scans)
        self._round_views: deque[bool] = deque(maxlen=most_scans)
        self._search = search
        self._last = np.zeros(2)
        self._middle = np.zeros(2)
        self._lines: LineMap | None = None
        self._field: LikelihoodField | None = None
        self._grid: branch_and_bound.PooledGrid | None = None
        self._undrawn = 0
        self._drawn = 0

    def add(self, scan: KeyScan, pose: Array) -> None:
        """Add a scan whose base frame has the pose ``(3,)``; the oldest leaves where there are too many."""
        self._points.append(transformed(pose, scan.points))
        self._normals.append(rotated(pose[2], scan.normals))
        self._squares.append(line_squares(self._points[-1], self._normals[-1]))
        self._poses.append(pose)
        self._round_views.append(_sees_all_round(scan))
        self._last = pose[:2].copy()
        self._lines = self._grid = None
        self._undrawn += 1

    def knows(self, scan: KeyScan, pose: Array, distance_m: float, turn_rad: float) -> bool:
        """Whether a scan at a pose ``(3,)`` shows nothing new: one of these was taken near there, and turned alike.

        Scanners that see all round may be turned as they like.
        """
        poses, round_views = np.array(self._poses).reshape(-1, 3), np.array(self._round_views, np.bool_)
        return bool(_is_known(poses, round_views, pose, _sees_all_round(scan), distance_m, turn_rad))

    @property
    def lines(self) -> LineMap:
        """The lines of all scans, averaged where they lie on each other."""
        if self._lines is None:
            points, normals = np.concatenate(self._points), np.concatenate(self._normals)
            self._lines = line_map_of_points(*averaged_lines(points, normals, np.concatenate(self._squares)))
        return self._lines

    def grid(self, config: branch_and_bound.SearchConfig) -> branch_and_bound.PooledGrid:
        """The pooled grid of the newest scans, for wide searches; the same until a scan is added."""
        if self._grid is None:
            points = np.concatenate(list(self._points)[-_WIDE_SCANS:])
            normals = np.concatenate(list(self._normals)[-_WIDE_SCANS:])
            self._grid = branch_and_bound.pooled_grid(config, joined(points, normals, config.resolution_m))
        return self._grid

    @property
    def field(self) -> LikelihoodField:
        """The likelihood field of all scans, round the last one or near it."""
        moved = math.dist(self._last, self._middle)
        if self._field is None or self._drawn + self._undrawn > _REDRAWN_SCANS or moved > _REDRAWN_M:
            self._middle, self._drawn, self._undrawn = self._last, 0, 0
            points, normals = np.concatenate(self._points), np.concatenate(self._normals)
            self._field = likelihood_field(points, normals, self._middle, self._search)
        while self._undrawn:
            draw(self._field, self._points[-self._undrawn], self._normals[-self._undrawn])
            self._drawn, self._undrawn = self._drawn + 1, self._undrawn - 1
        return self._field


def _sees_all_round(scan: KeyScan) -> bool:
    return len(scan.angles) > 1 and scan.angles[-1] - scan.angles[0] > _ALL_ROUND_RAD


@njit(cache=True)
def _is_known(
    poses: Array, round_views: NDArray[np.bool_], pose: Array, round_view: bool, distance_m: float, turn_rad: float
) -> bool:
    """``LocalSubmap.knows`` for scans at ``poses`` ``(n, 3)``, of which ``round_views`` ``(n,)`` see all round."""
    for k in range(len(poses)):
        if math.hypot(pose[0] - poses[k, 0], pose[1] - poses[k, 1]) < distance_m and (
            (round_view and round_views[k]) or abs(wrap(pose[2] - poses[k, 2])) < turn_rad
        ):
            return True
    return False
