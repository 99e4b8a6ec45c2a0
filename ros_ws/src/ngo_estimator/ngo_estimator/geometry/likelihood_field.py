"""Correlative search: the pose of a window at which most points of a scan lie near the points of others (Olson 2009).

A likelihood field holds, for every cell of a grid, how near the closest point is. The search rates every pose of a
window by the mean of the field at the scan's points, first coarsely, then finely round the best.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.planar_motion import Array, wrap

_LONGEST_GAP_M = 1.5
"""Neighbouring points farther apart are not joined."""

_FINER = 5
"""How much finer the second pass steps."""


@dataclass(frozen=True)
class SearchConfig:
    """How the search rates poses: cells of ``cell_m``; a point at the distance ``deviation_m`` from the closest one
    counts 0.61, at twice the distance 0.14. Cells up to ``reach_m`` from the middle are held. At most ``most_points``
    points of a scan are rated. A squared deviation from the prior costs ``prior_weight`` of the score, which is at
    most 1, and all of it at most ``most_prior``: wheels may slip. The coarse pass steps by ``step_m`` and
    ``step_deg``."""

    cell_m: float = 0.05
    deviation_m: float = 0.10
    reach_m: float = 25.0
    most_points: int = 120
    prior_weight: float = 0.01
    most_prior: float = 0.2
    step_m: float = 0.10
    step_deg: float = 2.0

    def __post_init__(self) -> None:
        if not (0.0 < self.cell_m <= self.deviation_m < self.reach_m < math.inf):
            raise ValueError(
                f"cell_m, deviation_m, reach_m are {self.cell_m}, {self.deviation_m}, {self.reach_m}; expected "
                "0 < cell_m <= deviation_m < reach_m"
            )
        if not (0.0 <= self.prior_weight < math.inf and 0.0 <= self.most_prior <= 1.0):
            raise ValueError(
                f"prior_weight, most_prior are {self.prior_weight}, {self.most_prior}; expected a weight of at least "
                "0, and 0 to 1"
            )
        if self.most_points < 1 or not (self.step_m > 0.0 and self.step_deg > 0.0):
            raise ValueError(
                f"most_points, step_m, step_deg are {self.most_points}, {self.step_m}, {self.step_deg}; expected "
                "positive numbers"
            )


@dataclass(frozen=True, eq=False)
class LikelihoodField:
    """Scores ``(rows, columns)`` of 0 to 1; the cell [0, 0] begins at ``corner`` ``(2,)``."""

    scores: NDArray[np.float32]
    corner: Array
    config: SearchConfig


def likelihood_field(points: Array, normals: Array, middle: Array, config: SearchConfig) -> LikelihoodField:
    """The field of points ``(n, 2)`` with normals ``(n, 2)``, zero where there is none, round ``middle`` ``(2,)``.

    Neighbours on one surface are joined by a line: points alone would draw a corridor's scan to the place where its
    rays meet those of the last one, and motion along the corridor would vanish.
    """
    side = 2 * math.ceil(config.reach_m / config.cell_m) + 1
    corner = middle - 0.5 * side * config.cell_m
    field = LikelihoodField(np.zeros((side, side), dtype=np.float32), corner, config)
    draw(field, points, normals)
    return field


def draw(field: LikelihoodField, points: Array, normals: Array) -> None:
    """Draw more points ``(n, 2)`` with normals ``(n, 2)`` into a field."""
    config = field.config
    _draw(field.scores, joined(points, normals, config.cell_m), field.corner, config.cell_m, config.deviation_m)


def search(
    field: LikelihoodField, points: Array, start: Array, prior: tuple[Array, Array], window: tuple[float, float]
) -> tuple[Array, float]:
    """The best pose ``(3,)`` within the window round a start, and its share of the field's largest score (0 to 1).

    Args:
        points: of the scan, ``(n, 2)`` in the frame that is to be found. Points without a normal are best left out:
            they lie far apart, and would fit where their rays met those of another scan.
        start: middle ``(3,)`` of the window.
        prior: mean ``(3,)`` and information ``(3, 3)`` of the pose.
        window: half sides, in m and in rad.
    """
    config = field.config
    few = points[:: max(1, math.ceil(len(points) / config.most_points))]
    if not len(few):
        return start, 0.0
    mean, information = prior
    pose, step_m, step_rad = start, config.step_m, math.radians(config.step_deg)
    half_m, half_rad = window
    score = 0.0
    for _ in range(2):
        pose, score = _best(
            field.scores, field.corner, config.cell_m, few, pose, mean, information,
            math.ceil(half_m / step_m), math.ceil(half_rad / step_rad), step_m, step_rad, config.prior_weight,
            config.most_prior,
        )  # fmt: skip
        half_m, half_rad = step_m, step_rad
        step_m, step_rad = step_m / _FINER, step_rad / _FINER
    return pose, score


@njit(cache=True)
def joined(points: Array, normals: Array, spacing: float) -> Array:
    """The points ``(n, 2)``, and more between neighbours whose surfaces face alike and whose gap runs along these."""
    between = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points) - 1):
        x, y = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
        length = math.hypot(x, y)
        alike = normals[i, 0] * normals[i + 1, 0] + normals[i, 1] * normals[i + 1, 1] > 0.95
        if alike and length < _LONGEST_GAP_M and abs(x * normals[i, 0] + y * normals[i, 1]) < 0.2 * length:
            between[i] = int(length / spacing)
    result = np.empty((len(points) + between.sum(), 2))
    place = 0
    for i in range(len(points)):
        for j in range(between[i] + 1):
            share = j / (between[i] + 1)
            for axis in range(2):
                step = points[i + 1, axis] - points[i, axis] if between[i] else 0.0
                result[place, axis] = points[i, axis] + share * step
            place += 1
    return result


@njit(cache=True)
def _draw(scores: NDArray[np.float32], points: Array, corner: Array, cell: float, deviation: float) -> None:
    reach = math.ceil(2.5 * deviation / cell)
    kernel = np.empty((2 * reach + 1, 2 * reach + 1), dtype=np.float32)
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            kernel[i, j] = math.exp(-0.5 * ((i - reach) ** 2 + (j - reach) ** 2) * (cell / deviation) ** 2)
    rows, columns = scores.shape
    for p in range(len(points)):
        row = math.floor((points[p, 1] - corner[1]) / cell)
        column = math.floor((points[p, 0] - corner[0]) / cell)
        if not (reach <= row < rows - reach and reach <= column < columns - reach) or scores[row, column] == 1.0:
            continue
        for i in range(2 * reach + 1):
            for j in range(2 * reach + 1):
                r, c = row + i - reach, column + j - reach
                scores[r, c] = max(scores[r, c], kernel[i, j])


@njit(cache=True)
def _best(
    scores: NDArray[np.float32],
    corner: Array,
    cell: float,
    points: Array,
    start: Array,
    mean: Array,
    information: Array,
    steps: int,
    turns: int,
    step_m: float,
    step_rad: float,
    prior_weight: float,
    most_prior: float,
) -> tuple[Array, float]:
    rows, columns = scores.shape
    best_total, best_score = -math.inf, 0.0
    best = start.copy()
    turned = np.empty_like(points)
    away = np.empty(3)
    for turn in range(-turns, turns + 1):
        yaw = start[2] + turn * step_rad
        cos, sin = math.cos(yaw), math.sin(yaw)
        for i in range(len(points)):
            turned[i, 0] = (cos * points[i, 0] - sin * points[i, 1] - corner[0]) / cell
            turned[i, 1] = (sin * points[i, 0] + cos * points[i, 1] - corner[1]) / cell
        away[2] = wrap(yaw - mean[2])
        for right in range(-steps, steps + 1):
            x = start[0] + right * step_m
            away[0] = x - mean[0]
            for up in range(-steps, steps + 1):
                y = start[1] + up * step_m
                away[1] = y - mean[1]
                cost = 0.0
                for a in range(3):
                    for b in range(3):
                        cost += away[a] * information[a, b] * away[b]
                cost = min(cost * prior_weight, most_prior)
                if -cost + 1.0 <= best_total:
                    continue
                total = 0.0
                for i in range(len(points)):
                    column, row = int(turned[i, 0] + x / cell), int(turned[i, 1] + y / cell)
                    if 0 <= row < rows and 0 <= column < columns:
                        total += scores[row, column]
                score = total / len(points)
                if score - cost > best_total:
                    best_total, best_score = score - cost, score
                    best[0], best[1], best[2] = x, y, wrap(yaw)
    return best, best_score
