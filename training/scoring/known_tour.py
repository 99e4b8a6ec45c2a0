"""The tour of a robot that knows the map: what an explorer cannot beat by much, made by greedy cover and a tour.

Places are added while they show the most that is not seen yet, until enough of the map is. A tour over them (nearest
insertion, 2-opt, or-opt) is then driven as an exploration is. It is a heuristic: the best tour may be shorter.
"""

from __future__ import annotations

import numpy as np

from ngo_explorer.known_map import KnownMap
from ngo_explorer.planner import cost_field, plan_path
from ngo_explorer.tours import tour
from training.data.explored_worlds import ExploredWorld

_CELL_M = 0.2  # of what places see
_APART = 3  # places in each direction of which one is a candidate
_SHARE = 0.97  # of the cells, so that 95 % are seen on the way


def known_tour(world: ExploredWorld, known: KnownMap, start_xy: np.ndarray, need_m: float) -> list[np.ndarray]:
    """Paths ``(n, 2)`` from place to place, in order."""
    scans, poses = world.exact_scans()
    seen = [_cells(pose, scan.ends + pose[:2]) for pose, scan in zip(poses[::_APART], scans[::_APART], strict=True)]
    cells, inverse = np.unique(np.concatenate(seen), return_inverse=True)
    bounds = np.cumsum([0, *(len(some) for some in seen)])
    sights = [inverse[begin:end] for begin, end in zip(bounds[:-1], bounds[1:], strict=True)]
    places = poses[::_APART, :2]
    field = cost_field(known, start_xy, need_m)
    chosen: list[int] = []
    covered = np.zeros(len(cells), np.bool_)
    while covered.mean() < _SHARE:
        gains = np.array([np.count_nonzero(~covered[sight]) for sight in sights])
        best = int(gains.argmax())
        if gains[best] == 0:
            break
        covered[sights[best]] = True
        sights[best] = np.zeros(0, np.int64)
        if _cost(known, field, places[best]) >= 0:
            chosen.append(best)
    points = places[chosen]
    costs = np.array([[_cost(known, cost_field(known, one, need_m), other) for other in points] for one in points])
    first = np.array([_cost(known, field, point) for point in points], np.float64)
    order, _ = tour(first, np.maximum(costs, 0).astype(np.float64), np.full(len(points), 1e-6), 1e6)
    paths, at = [], start_xy
    for index in order:
        path = plan_path(known, cost_field(known, at, need_m), at, points[index], need_m)
        if path is not None:
            paths.append(path)
            at = path[-1]
    return paths


def _cost(known: KnownMap, field: np.ndarray, point: np.ndarray) -> int:
    row, column = known.cell(point)
    return int(field[row // known.block, column // known.block])


def _cells(pose: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Numbers of the cells that rays from a pose to ``ends`` ``(n, 2)`` go through."""
    away = ends - pose[:2]
    lengths = np.hypot(*away.T)
    steps = np.arange(0.0, max(float(lengths.max()), _CELL_M), _CELL_M)
    points = pose[:2] + away[:, None] / np.maximum(lengths, 1e-6)[:, None, None] * steps[:, None]
    inside = steps < lengths[:, None]
    at = np.floor(points[inside] / _CELL_M).astype(np.int64)
    return np.unique(at[:, 1] * 1_000_000 + at[:, 0])
