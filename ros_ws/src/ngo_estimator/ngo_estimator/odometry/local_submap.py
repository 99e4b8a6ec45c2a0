"""The last key scans at their poses, as lines to register to and as a field to search in."""

from collections import deque

import numpy as np

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.likelihood_field import LikelihoodField, SearchConfig, likelihood_field
from ngo_estimator.geometry.line_map import LineMap, line_map_of_points
from ngo_estimator.geometry.planar_motion import Array, rotated, transformed


class LocalSubmap:
    """At most ``most_scans`` key scans in the odometry's frame; lines and field are made when first asked for."""

    def __init__(self, most_scans: int, search: SearchConfig) -> None:
        self._points: deque[Array] = deque(maxlen=most_scans)
        self._normals: deque[Array] = deque(maxlen=most_scans)
        self._search = search
        self._middle = np.zeros(2)
        self._lines: LineMap | None = None
        self._field: LikelihoodField | None = None

    def add(self, scan: KeyScan, pose: Array) -> None:
        """Add a scan whose base frame has the pose ``(3,)``; the oldest leaves where there are too many."""
        self._points.append(transformed(pose, scan.points))
        self._normals.append(rotated(pose[2], scan.normals))
        self._middle = pose[:2].copy()
        self._lines = self._field = None

    @property
    def lines(self) -> LineMap:
        """The lines of all scans."""
        if self._lines is None:
            self._lines = line_map_of_points(np.concatenate(self._points), np.concatenate(self._normals))
        return self._lines

    @property
    def field(self) -> LikelihoodField:
        """The likelihood field of all scans, round the last one."""
        if self._field is None:
            points, normals = np.concatenate(self._points), np.concatenate(self._normals)
            self._field = likelihood_field(points, normals, self._middle, self._search)
        return self._field
