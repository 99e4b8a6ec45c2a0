"""The last key scans at their poses, as lines to register to and as a score field to search in."""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.line_map import LineMap, averaged_lines, line_map_of_points, line_squares
from ngo_estimator.geometry.planar_motion import Array, compose, rotated, transformed
from ngo_estimator.geometry.score_field import RayCounts, ScoreField, ScoreFieldConfig, joined

_REDRAWN_M = 4.0
"""The counts are made anew where the robot is so far from their middle."""


class RollingSubmap:
    """At most ``most_scans`` key scans in the odometry's frame; lines and field are made when first asked for."""

    def __init__(self, most_scans: int, config: ScoreFieldConfig) -> None:
        self._scans: deque[tuple[Array, Array, NDArray[np.int64], Array]] = deque()  # points, normals, squares, drawn
        self._most, self._config = most_scans, config
        self._counts = RayCounts(config, np.zeros(2))
        self._lines: LineMap | None = None
        self._field: ScoreField | None = None

    def __len__(self) -> int:
        return len(self._scans)

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()
        self._counts.begin_at(np.full(2, math.inf))
        self._lines = self._field = None

    def add(self, scan: KeyScan, pose: Array) -> None:
        """Add a scan whose base frame has the pose ``(3,)``; the oldest leaves where there are too many."""
        points, normals = transformed(pose, scan.points), rotated(pose[2], scan.normals)
        sensor = compose(pose, scan.sensor_xyyaw)
        seen = np.isfinite(scan.ranges)
        angles, ranges = scan.angles[seen], scan.ranges[seen]
        ends = transformed(sensor, np.stack((ranges * np.cos(angles), ranges * np.sin(angles)), axis=-1))
        drawn = joined(points, normals, self._config.cell_m)
        self._scans.append((points, normals, line_squares(points, normals), drawn))
        if np.hypot(*(pose[:2] - self._counts.middle)) >= _REDRAWN_M:
            self._counts.move_to(pose[:2].copy())
        self._counts.add(sensor[:2], ends)
        if len(self._scans) > self._most:
            self._scans.popleft()
            self._counts.forget_oldest()
        self._lines = self._field = None

    def walls(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points ``(n, 2)`` in the odometry's frame are on walls ``(n,)``."""
        return self._counts.walls(points)

    @property
    def lines(self) -> LineMap:
        """The lines of all scans, averaged where they lie on each other."""
        if self._lines is None:
            points, normals, squares, _ = map(np.concatenate, zip(*self._scans, strict=True))
            squares[~self.walls(points)] = -1
            self._lines = line_map_of_points(*averaged_lines(points, normals, squares))
        return self._lines

    @property
    def field(self) -> ScoreField:
        """The score field round the newest scans."""
        if self._field is None:
            drawn = np.concatenate([drawn for *_, drawn in self._scans])
            self._field = self._counts.field(drawn[self.walls(drawn)])
        return self._field
