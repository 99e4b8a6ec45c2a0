"""Monte Carlo localisation with AMCL's model: likelihood field, differential drive, adaptive number of particles.

Thrun, Burgard and Fox, "Probabilistic Robotics" (2005), chapters 5, 6 and 8. The likelihood of a scan is the product
over some of its beams, as of AMCL's ``likelihood_field_prob``: with its sum of cubes (``likelihood_field``) the
particles did not come together within a start. The robot may start anywhere in the free space of the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt

from ngo_estimator.geometry.planar_motion import compose

_RESOLUTION_M = 0.05
_LEAST_HITS = 2
_BIN_M, _BIN_RAD = 0.5, math.radians(10.0)  # of the particles' histogram, as AMCL's
_KLD_ERROR, _KLD_QUANTILE = 0.05, 2.3263  # the quantile of 99 %


@dataclass(frozen=True)
class ParticleFilterConfig:
    """Settings, with AMCL's names in brackets.

    ``least`` and ``most`` particles (min_particles, max_particles), ``hit_m`` deviation of a range (sigma_hit),
    ``random`` weight of ranges that mean nothing (z_rand), ``beams`` a scan (max_beams), ``noise`` of the motion
    (alpha1 to alpha4), an update every ``step_m`` or ``step_deg`` (update_min_d, update_min_a). A pose is claimed where
    the particles' deviations are at most ``claim_m`` and ``claim_deg``.
    """

    least: int = 500
    most: int = 20_000
    hit_m: float = 0.2
    random: float = 0.2
    beams: int = 10
    noise: float = 0.05
    step_m: float = 0.2
    step_deg: float = 10.0
    claim_m: float = 0.25
    claim_deg: float = 5.0


@dataclass(frozen=True)
class RangeMap:
    """Distances (m) of cells from the nearest wall ``(rows, columns)``, the corner of cell (0, 0), and free cells.

    ``free`` ``(n, 2)`` are the middles (m) of cells that rays went through.
    """

    distance_m: np.ndarray
    origin_m: np.ndarray
    free: np.ndarray

    @classmethod
    def of_scans(cls, poses: np.ndarray, ranges: np.ndarray, angles_rad: np.ndarray) -> RangeMap:
        """The map of ranges ``(n, rays)`` (m, 0: nothing) along ``angles_rad`` ``(rays,)`` at poses ``(n, 3)``."""
        heading = poses[:, 2:] + angles_rad
        direction = np.stack((np.cos(heading), np.sin(heading)), axis=-1)
        ends = (poses[:, None, :2] + ranges[..., None] * direction)[ranges > 0.0]
        origin = ends.min(0) - 1.0
        shape = np.ceil((ends.max(0) + 1.0 - origin) / _RESOLUTION_M).astype(np.int64)[::-1]
        hits, passed = np.zeros(shape, np.int64), np.zeros(shape, bool)
        columns, rows = np.floor((ends - origin) / _RESOLUTION_M).astype(np.int64).T
        np.add.at(hits, (rows, columns), 1)
        for share in np.arange(0.0, 0.95, 0.02):
            inner = (poses[:, None, :2] + share * ranges[..., None] * direction)[ranges > 0.0]
            columns, rows = np.floor((inner - origin) / _RESOLUTION_M).astype(np.int64).T
            passed[rows, columns] = True
        walls = hits >= _LEAST_HITS
        distance = distance_transform_edt(~walls) * _RESOLUTION_M
        rows, columns = np.nonzero(passed & (distance > 0.15))
        free = origin + (np.stack((columns, rows), axis=-1) + 0.5) * _RESOLUTION_M
        return cls(distance.astype(np.float32), origin, free)


class ParticleFilter:
    """A filter that begins anywhere in the free space of a map."""

    def __init__(
        self, config: ParticleFilterConfig, range_map: RangeMap, angles_rad: np.ndarray, max_range_m: float, seed: int
    ) -> None:
        self.config, self._map = config, range_map
        self._rng = np.random.default_rng(seed)
        self._beams = np.linspace(0, len(angles_rad) - 1, min(config.beams, len(angles_rad))).round().astype(np.int64)
        self._angles, self._max_range_m = angles_rad[self._beams], max_range_m
        chosen = range_map.free[self._rng.integers(len(range_map.free), size=config.most)]
        chosen = chosen + self._rng.uniform(-0.5, 0.5, chosen.shape) * _RESOLUTION_M
        self._particles = np.column_stack((chosen, self._rng.uniform(-math.pi, math.pi, config.most)))
        self._motion = np.zeros(3)
        self._new = True

    def update(self, relative: np.ndarray, ranges: np.ndarray) -> np.ndarray | None:
        """Take a step ``(3,)`` and the ranges ``(rays,)`` after it; returns the pose ``(3,)`` where it is known."""
        self._motion = compose(self._motion, np.asarray(relative, np.float64))
        far = math.hypot(self._motion[0], self._motion[1]) >= self.config.step_m
        if self._new or far or abs(self._motion[2]) >= math.radians(self.config.step_deg):
            self._move(self._motion)
            self._weigh(ranges)
            self._motion, self._new = np.zeros(3), False
        return self._estimate()

    def _move(self, motion: np.ndarray) -> None:
        noise, count = self.config.noise, len(self._particles)
        way = math.hypot(motion[0], motion[1])
        first = math.atan2(motion[1], motion[0]) if way > 0.01 else 0.0
        backwards = abs(first) > 0.5 * math.pi  # a robot that reverses does not turn about
        if backwards:
            first, way = math.remainder(first + math.pi, 2.0 * math.pi), -way
        second = math.remainder(motion[2] - first, 2.0 * math.pi)
        turns = [noise * math.hypot(angle, way) for angle in (first, second)]
        travel = noise * math.hypot(way, math.hypot(first, second))
        heading = self._particles[:, 2] + first + turns[0] * self._rng.standard_normal(count)
        ways = way + travel * self._rng.standard_normal(count)
        self._particles[:, 0] += ways * np.cos(heading)
        self._particles[:, 1] += ways * np.sin(heading)
        self._particles[:, 2] = heading + second + turns[1] * self._rng.standard_normal(count)

    def _weigh(self, ranges: np.ndarray) -> None:
        config, seen = self.config, ranges[self._beams].astype(np.float64)
        there = (seen > 0.0) & (seen < self._max_range_m)
        weights = _likelihoods(
            self._particles, seen[there], self._angles[there], self._map.distance_m, self._map.origin_m,
            _RESOLUTION_M, config.hit_m, 1.0 - config.random, config.random / self._max_range_m,
        )  # fmt: skip
        weights = np.exp(weights - weights.max())
        weights /= weights.sum()
        self._particles = self._particles[self._resampled(weights)]

    def _resampled(self, weights: np.ndarray) -> np.ndarray:
        """Particles drawn by their weights, as many as the histogram of what was drawn asks for."""
        most, least = self.config.most, self.config.least
        positions = (self._rng.random() + np.arange(most)) / most
        drawn = np.minimum(np.searchsorted(np.cumsum(weights), positions), len(weights) - 1)
        drawn = self._rng.permutation(drawn)
        some = self._particles[drawn]
        bins = np.floor(np.column_stack((some[:, :2] / _BIN_M, _wrapped(some[:, 2]) / _BIN_RAD))).astype(np.int64)
        _, first = np.unique(bins, axis=0, return_index=True)
        filled = np.searchsorted(np.sort(first), np.arange(1, most + 1))  # bins after so many draws
        k = np.maximum(filled - 1, 1).astype(np.float64)
        needed = k / (2.0 * _KLD_ERROR) * (1.0 - 2.0 / (9.0 * k) + np.sqrt(2.0 / (9.0 * k)) * _KLD_QUANTILE) ** 3
        enough = np.flatnonzero(np.arange(1, most + 1) >= np.maximum(needed, least))
        return drawn[: int(enough[0]) + 1] if len(enough) else drawn

    def _estimate(self) -> np.ndarray | None:
        """The mean of the particles where they are together."""
        x, y = self._particles[:, :2].mean(0)
        cos, sin = np.cos(self._particles[:, 2]).mean(), np.sin(self._particles[:, 2]).mean()
        spread = math.sqrt(float(self._particles[:, :2].var(0).sum()))
        turned = math.sqrt(max(0.0, -2.0 * math.log(max(math.hypot(cos, sin), 1e-12))))
        if spread > self.config.claim_m or turned > math.radians(self.config.claim_deg):
            return None
        return np.array((x, y, math.atan2(sin, cos)))


def _wrapped(angle: np.ndarray) -> np.ndarray:
    wrapped: np.ndarray = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped


@njit(cache=True)
def _likelihoods(
    particles: np.ndarray, ranges: np.ndarray, angles: np.ndarray, distance: np.ndarray, origin: np.ndarray,
    resolution: float, hit_m: float, hit: float, random: float,
) -> np.ndarray:  # fmt: skip
    """Logarithm of the weight ``(n,)`` of each particle."""
    rows, columns = distance.shape
    far = distance.max()
    weights = np.zeros(len(particles))
    for i in range(len(particles)):
        for k in range(len(ranges)):
            heading = particles[i, 2] + angles[k]
            column = math.floor((particles[i, 0] + ranges[k] * math.cos(heading) - origin[0]) / resolution)
            row = math.floor((particles[i, 1] + ranges[k] * math.sin(heading) - origin[1]) / resolution)
            away = distance[row, column] if 0 <= column < columns and 0 <= row < rows else far
            weights[i] += math.log(hit * math.exp(-0.5 * (away / hit_m) ** 2) + random)
    return weights
