"""The two likeliest poses of a scan in a score field, under a prior of several hypotheses (branch and bound).

The score of a pose is the mean score of its points, and ``weight`` times the logarithm of the prior: that of the
hypothesis that is likeliest there (a max-mixture: Olson and Agarwal 2013). Blocks of poses have a bound of both; the
best block is split first (Hess et al. 2016, section V).
"""

import heapq
import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.planar_motion import Array, wrap
from ngo_estimator.geometry.score_field import ScoreField

_MOST_BLOCKS = 20_000


@dataclass(frozen=True, eq=False)
class Mixture:
    """Hypotheses of a pose: ``means`` ``(k, 3)``, ``deviations`` ``(k, 2)`` (m, rad), ``log_weights`` ``(k,)``, which
    hold the densities' peaks."""

    means: Array
    deviations: Array
    log_weights: Array

    def widened(self, metres: float, radians: float, alone: bool = False) -> "Mixture":
        """The same where the last hypothesis has at least these deviations, or it ``alone``."""
        first = len(self.means) - 1 if alone else 0
        deviations, logs = self.deviations[first:].copy(), self.log_weights[first:].copy()
        deviations[-1] = np.maximum(deviations[-1], (metres, radians))
        ratio = np.log(deviations[-1] / self.deviations[-1])
        logs[-1] -= 2.0 * ratio[0] + ratio[1]
        return Mixture(self.means[first:], deviations, logs)

    def logs(self, pose: Array) -> Array:
        """Logarithm ``(k,)`` of the density of each at a pose ``(3,)``."""
        result: Array = _logs(self.means, self.deviations, self.log_weights, pose)
        return result


def two_modes(
    field: ScoreField,
    points: Array,
    centre: Array,
    half: tuple[float, float],
    step_rad: float,
    prior: Mixture,
    weight: float,
    apart: tuple[float, float],
    margin: float,
) -> list[tuple[Array, float]]:
    """The best pose ``(3,)`` with its total, and the best of those ``apart`` (m, rad) from it.

    The second is there if it is no more than ``margin`` worse. Searched is ``half`` (m, rad) to each side of ``centre``
    ``(3,)``, at headings ``step_rad`` apart. ``points`` ``(n, 2)`` are those of the scan; at least one.
    """
    cell = field.config.cell_m
    cells, turns = max(1, math.ceil(half[0] / cell)), max(1, math.ceil(half[1] / step_rad))
    found = _modes(
        field.levels,
        round(255 * field.config.unknown),
        points,
        field.corner,
        centre,
        (turns, step_rad),
        cells,
        cell,
        prior.means,
        prior.deviations,
        prior.log_weights,
        weight,
        apart[0] / cell,
        apart[1],
        margin,
        _MOST_BLOCKS,
    )
    x, y, yaw = centre.tolist()
    return [
        (np.array((x + column * cell, y + row * cell, wrap(yaw + (a - turns) * step_rad))), total)
        for total, a, column, row in found
    ]


@njit(cache=True)
def _logs(means: Array, deviations: Array, log_weights: Array, pose: Array) -> Array:
    result = log_weights.copy()
    for k in range(len(means)):
        x, y, turn = means[k, 0] - pose[0], means[k, 1] - pose[1], wrap(means[k, 2] - pose[2])
        result[k] -= 0.5 * ((x * x + y * y) / deviations[k, 0] ** 2 + (turn / deviations[k, 1]) ** 2)
    return result


@njit(cache=True)
def _sum(level: NDArray[np.uint8], cells: NDArray[np.int32], across: int, up: int, unknown: int) -> int:
    rows, columns = level.shape
    # Negative numbers are large ones without a sign: one comparison tells both borders.
    high, wide = np.uint32(rows), np.uint32(columns)
    total = 0
    for k in range(len(cells)):
        column, row = np.uint32(cells[k, 0] + across), np.uint32(cells[k, 1] + up)
        total += level[row, column] if column < wide and row < high else unknown
    return total


@njit(cache=True)
def _log_prior(
    x: float, y: float, side: float, yaw: float, means: Array, information: Array, logs: Array
) -> float:  # fmt: skip
    """The largest over a block whose least corner is (x, y)."""
    best = -math.inf
    for k in range(len(means)):
        dx = max(x - means[k, 0], means[k, 0] - x - side, 0.0)
        dy = max(y - means[k, 1], means[k, 1] - y - side, 0.0)
        turn = wrap(yaw - means[k, 2])
        value = logs[k] - 0.5 * ((dx * dx + dy * dy) * information[k, 0] + turn * turn * information[k, 1])
        best = max(best, value)
    return best


@njit(cache=True)
def _modes(
    levels: NDArray[np.uint8], unknown: int, points: Array, corner: Array, centre: Array, headings: tuple[int, float],
    half: int, cell: float, poses: Array, deviations: Array, logs: Array, weight: float, apart: float,
    apart_rad: float, margin: float, most_blocks: int,
) -> list[tuple[float, int, int, int]]:  # fmt: skip
    """Total, heading, column and row of one or two modes; ``headings`` are so many to each side, and their step."""
    turns, yaw = headings[1] * np.arange(-headings[0], headings[0] + 1), centre[2]
    means, information = poses - centre, 1.0 / deviations**2
    for k in range(len(means)):
        means[k, 2] = wrap(means[k, 2])
    depth = len(levels) - 1
    while depth > 0 and (1 << depth) > half + 1:
        depth -= 1
    cells = np.empty((len(turns), len(points), 2), np.int32)
    for a in range(len(turns)):
        cos, sin = math.cos(yaw + turns[a]), math.sin(yaw + turns[a])
        for k in range(len(points)):
            x = cos * points[k, 0] - sin * points[k, 1] + centre[0] - corner[0]
            y = sin * points[k, 0] + cos * points[k, 1] + centre[1] - corner[1]
            cells[a, k, 0], cells[a, k, 1] = math.floor(x / cell), math.floor(y / cell)
    scale = 1.0 / (255.0 * len(points))
    heap = [(0.0, 0, 0, 0, 0) for _ in range(0)]
    step = 1 << depth
    for a in range(len(turns)):
        for across in range(-half, half + 1, step):
            for up in range(-half, half + 1, step):
                total = scale * _sum(levels[depth], cells[a], across, up, unknown)
                side = (step - 1) * cell
                total += weight * _log_prior(across * cell, up * cell, side, turns[a], means, information, logs)
                heap.append((-total, depth, a, across, up))
    heapq.heapify(heap)
    result = [(0.0, 0, 0, 0) for _ in range(0)]
    blocks = 0
    while len(heap) > 0 and blocks < most_blocks:
        negative, level, a, across, up = heapq.heappop(heap)
        if len(result) == 1:
            best = result[0]
            if -negative < best[0] - margin:
                break
            last = (1 << level) - 1
            far_x = max(abs(across - best[2]), abs(min(across + last, half) - best[2]))
            far_y = max(abs(up - best[3]), abs(min(up + last, half) - best[3]))
            if far_x * far_x + far_y * far_y <= apart * apart and abs(turns[a] - turns[best[1]]) <= apart_rad:
                continue
        if level == 0:
            result.append((-negative, a, across, up))
            if len(result) == 2:
                break
            continue
        blocks += 1
        size = 1 << (level - 1)
        for i in range(2):
            for j in range(2):
                column, row = across + i * size, up + j * size
                if column <= half and row <= half:
                    total = scale * _sum(levels[level - 1], cells[a], column, row, unknown)
                    side = (size - 1) * cell
                    total += weight * _log_prior(column * cell, row * cell, side, turns[a], means, information, logs)
                    heapq.heappush(heap, (-total, level - 1, a, column, row))
    return result
