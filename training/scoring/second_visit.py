"""How far a map is doubled where a robot comes back to a place, without any truth."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import fftconvolve
from scipy.spatial import KDTree

from ngo_estimator.geometry.planar_motion import Array, compose, rotated, transformed
from training.scoring.metrics import rigid_motion

STRETCH_M = 20.0  # Way at the end of a drive that is the second visit.
APART_M = 100.0  # Least way from the first visit to the second.

_EVERY_M = 0.5  # of way: a scan
_CELL_M = 0.25
_REACH_M, _REACH_DEG, _STEP_DEG = 15.0, 20.0, 1.0
_MATCH_M = 0.3
_REFINED_M = (1.0, 0.5, 0.5, 0.3, 0.3, 0.3)  # farthest partners, each for a few iterations
_ITERATIONS = 5


@dataclass(frozen=True)
class SecondVisit:
    """``metres`` and ``degrees`` from where the map has the second visit to where its scans fit those of the first.

    ``share`` of the points have a point of the first visit within 0.3 m where they fit, ``share_before`` in the map.
    """

    metres: float
    degrees: float
    share: float
    share_before: float


def second_visit(points: list[Array], poses: Array) -> SecondVisit:
    """Compare the scans of the last 20 m with all that were taken 100 m of way or more before them.

    Args:
        points: of each scan in the robot's frame ``(m, 2)``.
        poses: of the robot at each scan in the map ``(scans, 3)``.

    The scans of the stretch move as one rigid cloud. The best shift within 15 m and 20 deg is found by correlating
    rasters, then refined by registration point to point. ``metres`` is how far the middle of the stretch's way moves.

    Raises:
        ValueError: the drive is shorter than the stretch and the way before it.
    """
    way_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    used = np.unique(np.searchsorted(way_m, np.arange(0.0, way_m[-1], _EVERY_M)))
    first, second = used[way_m[used] < way_m[-1] - STRETCH_M - APART_M], used[way_m[used] >= way_m[-1] - STRETCH_M]
    if not len(first) or not len(second):
        raise ValueError(f"the way is {way_m[-1]:.1f} m; expected more than {STRETCH_M + APART_M:g} m")
    old = _thinned(np.concatenate([transformed(poses[k], points[k]) for k in first]))
    cloud = _thinned(np.concatenate([transformed(poses[k], points[k]) for k in second]))
    middle = poses[second, :2].mean(axis=0)
    old, cloud = old - middle, cloud - middle  # a turn moves the middle by nothing
    tree = KDTree(old)
    motion = _refined(tree, cloud, _correlated(old, cloud))
    shares = [float((tree.query(transformed(pose, cloud))[0] < _MATCH_M).mean()) for pose in (motion, np.zeros(3))]
    return SecondVisit(float(np.hypot(*motion[:2])), float(np.degrees(abs(motion[2]))), *shares)


def _thinned(points: Array) -> Array:
    """One point a cell."""
    _, index = np.unique(np.floor(points / _CELL_M).astype(np.int64), axis=0, return_index=True)
    return points[index]


def _correlated(old: Array, cloud: Array) -> Array:
    """The motion ``(3,)`` of the cloud after which most of it lies on the old points, to a cell and a step."""
    reach = int(_REACH_M / _CELL_M)
    radius = np.linalg.norm(cloud, axis=1).max()
    size = 2 * (int(radius / _CELL_M) + 1) + 1
    # The old raster has the reach on each side of the cloud's: the valid part of the correlation is the window.
    target = np.minimum(_raster(old, size + 2 * reach, spread=True), 1.0)
    best, motion = -1.0, np.zeros(3)
    for degrees in np.arange(-_REACH_DEG, _REACH_DEG + 0.5 * _STEP_DEG, _STEP_DEG):
        source = _raster(rotated(np.radians(degrees), cloud), size)
        scores = fftconvolve(target, source[::-1, ::-1], mode="valid")
        row, column = np.unravel_index(int(scores.argmax()), scores.shape)
        if scores[row, column] > best:
            best = float(scores[row, column])
            motion = np.array(((row - reach) * _CELL_M, (column - reach) * _CELL_M, np.radians(degrees)))
    return motion


def _raster(points: Array, size: int, spread: bool = False) -> Array:
    """Counts of points in cells ``(size, size)`` around the origin; with ``spread`` in their neighbours, too."""
    cells = np.floor(points / _CELL_M + 0.5 * size).astype(np.int64)
    offsets = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)] if spread else [(0, 0)]
    raster = np.zeros((size, size))
    for offset in offsets:
        moved = cells + offset
        inside = ((moved >= 0) & (moved < size)).all(axis=1)
        np.add.at(raster, tuple(moved[inside].T), 1.0)
    return raster


def _refined(tree: KDTree, cloud: Array, motion: Array) -> Array:
    """The motion ``(3,)`` after registration, nearest point to nearest point, ever closer."""
    for most_m in np.repeat(_REFINED_M, _ITERATIONS):
        moved = transformed(motion, cloud)
        away, index = tree.query(moved)
        near = away < most_m
        if near.sum() < 3:
            return motion
        motion = compose(rigid_motion(moved[near], tree.data[index[near]]), motion)
    return motion
