"""Scans of buildings made of straight walls, and ways through them."""

import math

import numpy as np

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import all_between as between
from ngo_estimator.geometry.planar_motion import compose
from ngo_estimator.geometry.scan_points import Mounting, key_scan
from tests.unit.ngo_estimator.ray_casting import cast, fan, walls

__all__ = ["HALLWAY", "ROUND", "TWICE", "between", "drifted", "outline", "scan_at", "way"]

ANGLES = fan()
MOUNTING = Mounting(np.zeros(3))


def outline(*corners: tuple[float, float]) -> np.ndarray:
    """Walls ``(n, 4)`` from corner to corner, closed."""
    return walls(corners).reshape(-1, 4)


HALLWAY = walls(
    ((0, 0), (10, 0), (10, 8), (0, 8)),
    ((2, 2), (8, 2), (8, 6), (5, 6), (5, 5), (2, 5)),
    ((0, 3), (0.5, 3), (0.5, 4.2), (0, 4.2)),
    ((9.3, 5), (10, 5), (10, 6), (9.6, 6.2)),
    ((4, 0), (4.3, 0.5), (5.5, 0.4), (5.6, 0)),
).reshape(-1, 4)


def scan_at(walls: np.ndarray, pose: np.ndarray, random: np.random.Generator, farthest_m: float = 30.0) -> KeyScan:
    """A scan of 181 rays over 180 deg with 1 cm noise."""
    nearest = cast(walls.reshape(-1, 2, 2), pose, ANGLES)
    noisy = nearest + random.normal(0.0, 0.01, len(nearest))
    return key_scan(0, ANGLES, np.where(nearest < farthest_m, noisy, np.inf), (0.05, farthest_m), MOUNTING)


def way(*corners: tuple[float, float], step_m: float = 0.3) -> np.ndarray:
    """Poses ``(n, 3)`` along a way, looking ahead. Corners are turned on the spot in three steps."""
    poses = []
    for start, end in zip(corners[:-1], corners[1:], strict=True):
        heading = math.atan2(end[1] - start[1], end[0] - start[0])
        if poses:
            turn = (heading - poses[-1][2] + math.pi) % (2.0 * math.pi) - math.pi
            poses += [(*start, poses[-1][2] + turn * k / 3.0) for k in (1, 2)]
        count = max(1, round(math.dist(start, end) / step_m))
        poses += [(*(np.array(start) + (np.array(end) - start) * k / count), heading) for k in range(count)]
    return np.array(poses)


ROUND = ((1.0, 1.0), (9.0, 1.0), (9.0, 7.0), (1.0, 7.0))
TWICE = way(*ROUND, *ROUND, ROUND[0])


def drifted(poses: np.ndarray, drift: tuple[float, float, float]) -> np.ndarray:
    """The same way, with an error ``drift`` in each step (m, m, rad)."""
    result = [poses[0]]
    for step in between(poses[:-1], poses[1:]) + drift:
        result.append(compose(result[-1], step))
    return np.array(result)
