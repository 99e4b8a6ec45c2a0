"""Point-to-line ICP: the pose at which the points of one scan lie on the lines of others (Censi 2008).

Every step pairs each point with the nearest line that faces the same way, and takes one robust Gauss-Newton step on the
distances, with less and less tolerance. A prior takes part by its information. The covariance is that of the whole
problem: where the lines leave a direction open, as a corridor does, the prior's remains.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.geometry.line_map import CELL_M, LineMap
from ngo_estimator.geometry.planar_motion import Array, inverted, wrap


@dataclass(frozen=True)
class IcpConfig:
    """How scans are registered.

    ``steps`` Gauss-Newton steps at most. Cauchy's kernel and the gate shrink from their ``first`` to their ``last``
    value within ``annealing_steps``. Two surfaces are one only where their normals differ by at most
    ``facing_deg``. ``fit_m`` is the distance within which a point counts as fitted. ``noise_m`` is the least deviation
    of a distance; larger residuals raise it. ``correlation`` is the number of neighbouring points that share one error:
    calibration, uneven walls and wrong pairs repeat from point to point, so that n points tell no more than
    n / ``correlation`` independent ones. ``normal_deviations`` of the scatter of noisy normals are no information.
    """

    steps: int = 16
    annealing_steps: int = 6
    first_kernel_m: float = 0.10
    last_kernel_m: float = 0.03
    first_gate_m: float = 0.30
    last_gate_m: float = 0.12
    facing_deg: float = 30.0
    fit_m: float = 0.10
    noise_m: float = 0.015
    correlation: float = 8.0
    normal_deviations: float = 2.0

    def __post_init__(self) -> None:
        check(self, "steps annealing_steps", "at least 1", lambda x: x >= 1)
        check_positive(self, "first_kernel_m last_kernel_m first_gate_m last_gate_m fit_m noise_m")
        first_kernel_m, first_gate_m = self.first_kernel_m, self.first_gate_m
        check(self, "last_kernel_m", f"at most first_kernel_m, {first_kernel_m}", lambda x: x <= first_kernel_m)
        check(self, "last_gate_m", f"at most first_gate_m, {first_gate_m}", lambda x: x <= first_gate_m)
        check(self, "first_gate_m", f"at most {CELL_M}", lambda x: x <= CELL_M)
        check(self, "facing_deg", "over 0 to 90", lambda x: 0.0 < x <= 90.0)
        check(self, "correlation", "at least 1", lambda x: x >= 1.0)
        check(self, "normal_deviations", "finite, from 0 on", lambda x: 0.0 <= x < math.inf)


@dataclass(frozen=True, eq=False)
class Registration:
    """Where a scan was: its pose ``(3,)`` in the map's frame, the covariance ``(3, 3)`` of that pose's components
    (m, m, rad; prior included), the information ``(3, 3)`` of the lines alone, the share of its points with normals
    that lie on lines, and how many these are."""

    pose: Array
    covariance: Array
    information: Array
    share: float
    fitted: int


def icp(
    lines: LineMap,
    points: Array,
    normals: Array,
    start: Array,
    prior: tuple[Array, Array] | None = None,
    config: IcpConfig | None = None,
    open_share: float = 0.0,
) -> Registration:
    """Register points to lines.

    Args:
        lines: the map, of one scan or of many.
        points, normals: ``(n, 2)`` in the frame that is to be found, normals zero where there is none. Points of
            several scans may be joined, once they are in one frame.
        start: pose ``(3,)`` of that frame in the map's.
        prior: mean ``(3,)`` and information ``(3, 3)`` of the pose; without it directions that no line holds keep
            their start, at a deviation of 1 m and 1 rad.
        config: settings.
        open_share: over 0 the direction of motion that the lines hold least counts as far as the normals of both sides
            agree on it: their noise is independent. It is open, and left to the prior, where the mean squared slope of
            the lines against it is below this share.

    Raises:
        ValueError: a shape is wrong or a number is not finite.
    """
    config = config or IcpConfig()
    start = np.asarray(start, dtype=np.float64)
    mean, information = (start, np.eye(3)) if prior is None else prior
    if not 0.0 <= open_share < 0.5:
        raise ValueError(f"open_share is {open_share}; expected 0 to below 0.5")
    if points.ndim != 2 or points.shape[1] != 2 or points.shape != normals.shape:
        raise ValueError(f"points and normals have shapes {points.shape} and {normals.shape}; expected (n, 2) twice")
    if start.shape != (3,) or mean.shape != (3,) or information.shape != (3, 3):
        raise ValueError(
            f"start, mean and information have shapes {start.shape}, {mean.shape} and {information.shape}; expected "
            "(3,), (3,) and (3, 3)"
        )
    pose, covariance, data, fitted, tried = _icp(
        lines.points,
        lines.normals,
        lines.first,
        lines.corner,
        lines.shape[0],
        lines.shape[1],
        points,
        normals,
        start,
        mean,
        information,
        config.steps,
        config.annealing_steps,
        (config.first_kernel_m, config.last_kernel_m),
        (config.first_gate_m, config.last_gate_m),
        math.cos(math.radians(config.facing_deg)),
        config.fit_m,
        config.noise_m,
        config.correlation,
        (config.normal_deviations, open_share),
    )
    return Registration(pose, covariance, data, fitted / max(tried, 1), int(fitted))


@njit(cache=True)
def _icp(
    map_points: Array,
    map_normals: Array,
    first: NDArray[np.int64],
    corner: Array,
    rows: int,
    columns: int,
    points: Array,
    normals: Array,
    start: Array,
    mean: Array,
    prior: Array,
    steps: int,
    annealing: int,
    kernels: tuple[float, float],
    gates: tuple[float, float],
    facing: float,
    fit: float,
    noise: float,
    correlation: float,
    noisy: tuple[float, float],
) -> tuple[Array, Array, Array, int, int]:
    if not (np.isfinite(start).all() and np.isfinite(mean).all() and np.isfinite(prior).all()):
        raise ValueError("start or prior are not finite; expected finite numbers")
    pose = start.copy()
    data = np.zeros((3, 3))
    total = prior.copy()
    fitted, tried = 0, 0
    variance = noise * noise
    normal_deviations, open_share = noisy
    for step in range(steps + 1):
        done = min(step / annealing, 1.0)
        kernel = kernels[0] * (kernels[1] / kernels[0]) ** done
        gate = gates[0] * (gates[1] / gates[0]) ** done
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        g0, g1, g2 = 0.0, 0.0, 0.0
        c00, c01, c11, e00, e01, e11 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # of normals that agree, of those that do not
        squares, weights = 0.0, 0.0
        fitted, tried = 0, 0
        for i in range(len(points)):
            nx, ny = normals[i, 0], normals[i, 1]
            if nx == 0.0 and ny == 0.0:
                continue
            tried += 1
            arm_x, arm_y = cos * points[i, 0] - sin * points[i, 1], sin * points[i, 0] + cos * points[i, 1]
            x, y = arm_x + pose[0], arm_y + pose[1]
            turned_x, turned_y = cos * nx - sin * ny, sin * nx + cos * ny
            best = nearest(
                map_points, map_normals, first, corner, rows, columns, x, y, turned_x, turned_y, facing
            )  # fmt: skip
            if best < 0:
                continue
            mx, my = map_normals[best, 0], map_normals[best, 1]
            distance = mx * (x - map_points[best, 0]) + my * (y - map_points[best, 1])
            if abs(distance) > gate:
                continue
            if abs(distance) < fit:
                fitted += 1
            weight = 1.0 / (1.0 + (distance / kernel) ** 2)
            lever = my * arm_x - mx * arm_y
            squares += weight * distance * distance
            weights += weight
            h00 += weight * mx * mx
            h01 += weight * mx * my
            h02 += weight * mx * lever
            h11 += weight * my * my
            h12 += weight * my * lever
            h22 += weight * lever * lever
            off_x, off_y = mx - turned_x, my - turned_y
            c00 += weight * mx * turned_x
            c01 += 0.5 * weight * (mx * turned_y + my * turned_x)
            c11 += weight * my * turned_y
            e00 += weight * off_x * off_x
            e01 += weight * off_x * off_y
            e11 += weight * off_y * off_y
            g0 += weight * mx * distance
            g1 += weight * my * distance
            g2 += weight * lever * distance
        if weights > 0.0:
            variance = max(squares / weights, noise * noise)
        scale = 1.0 / (variance * correlation)
        data = np.array(((h00, h01, h02), (h01, h11, h12), (h02, h12, h22))) * scale
        slope = np.array((g0, g1, g2)) * scale
        if open_share > 0.0 and weights > 0.0:
            # The direction that the walls hold least: what both scans' normals say of it, and how far they disagree.
            direction = 0.5 * math.atan2(2.0 * h01, h00 - h11)
            x, y = -math.sin(direction), math.cos(direction)
            claimed = h00 * x * x + 2.0 * h01 * x * y + h11 * y * y
            agreed = c00 * x * x + 2.0 * c01 * x * y + c11 * y * y
            apart = e00 * x * x + 2.0 * e01 * x * y + e11 * y * y
            agreed -= normal_deviations * 0.5 * apart * math.sqrt(correlation / weights)
            held = 0.0 if agreed < open_share * weights else min(agreed / claimed, 1.0)
            if held < 1.0:
                along = np.array((x, y, 0.0))
                data -= (1.0 - math.sqrt(held)) * np.outer(along, along @ data)
                data -= (1.0 - math.sqrt(held)) * np.outer(data @ along, along)
                slope -= (1.0 - held) * along * (along @ slope)
        total = data + prior
        if step == steps:
            break
        away = pose - mean
        away[2] = wrap(away[2])
        gradient = slope + prior @ away
        change = np.linalg.solve(total, gradient)
        pose = pose - change
        pose[2] = wrap(pose[2])
        if step >= annealing and abs(change[0]) + abs(change[1]) < 2e-4 and abs(change[2]) < 5e-5:
            break
    return pose, inverted(total), data, fitted, tried


@njit(cache=True)
def nearest(
    points: Array,
    normals: Array,
    first: NDArray[np.int64],
    corner: Array,
    rows: int,
    columns: int,
    x: float,
    y: float,
    nx: float,
    ny: float,
    facing: float,
) -> int:
    """The nearest point whose surface faces like ``(nx, ny)``, within a cell's side, or -1."""
    row = math.floor((y - corner[1]) / CELL_M)
    column = math.floor((x - corner[0]) / CELL_M)
    best, least = -1, CELL_M * CELL_M
    if row < -1 or row > rows or column < -1 or column > columns:
        return best
    # How far the neighbouring cells are: the point's own cell comes first, and mostly none of the others can be nearer.
    from_left, from_low = x - corner[0] - column * CELL_M, y - corner[1] - row * CELL_M
    for i in range(3):
        r = row + (0, -1, 1)[i]
        up = (0.0, from_low, CELL_M - from_low)[i]
        if r < 0 or r >= rows or up * up >= least:
            continue
        for j in range(3):
            c = column + (0, -1, 1)[j]
            across = (0.0, from_left, CELL_M - from_left)[j]
            if c < 0 or c >= columns or up * up + across * across >= least:
                continue
            for k in range(first[r * columns + c], first[r * columns + c + 1]):
                away_x, away_y = points[k, 0] - x, points[k, 1] - y
                square = away_x * away_x + away_y * away_y
                if square < least and normals[k, 0] * nx + normals[k, 1] * ny > facing:
                    best, least = k, square
    return best
