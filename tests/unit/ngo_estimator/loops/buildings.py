"""Scans of buildings made of straight walls."""

import math

import numpy as np

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.scan_points import Mounting, key_scan

ANGLES = np.radians(np.arange(-90.0, 91.0))
MOUNTING = Mounting(np.zeros(3))


def outline(*corners: tuple[float, float]) -> np.ndarray:
    """Walls ``(n, 4)`` from corner to corner, closed."""
    ends = np.array(corners)
    return np.concatenate((ends, np.roll(ends, -1, axis=0)), axis=1)


HALLWAY = np.concatenate(
    (
        outline((0, 0), (10, 0), (10, 8), (0, 8)),
        outline((2, 2), (8, 2), (8, 6), (5, 6), (5, 5), (2, 5)),
        outline((0, 3), (0.5, 3), (0.5, 4.2), (0, 4.2)),
        outline((9.3, 5), (10, 5), (10, 6), (9.6, 6.2)),
        outline((4, 0), (4.3, 0.5), (5.5, 0.4), (5.6, 0)),
    )
)


def scan_at(walls: np.ndarray, pose: np.ndarray, random: np.random.Generator, farthest_m: float = 30.0) -> KeyScan:
    """A scan of 181 rays over 180 deg with 1 cm noise."""
    directions = np.stack((np.cos(pose[2] + ANGLES), np.sin(pose[2] + ANGLES)), axis=-1)[:, None]
    start, along = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    across = directions[..., 0] * along[:, 1] - directions[..., 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
        share = (start[:, 0] * directions[..., 1] - start[:, 1] * directions[..., 0]) / across
    hit = (ranges > 0.0) & (share >= 0.0) & (share <= 1.0)
    nearest = np.where(hit, ranges, np.inf).min(1)
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


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses ``(n, 3)`` seen from poses ``(n, 3)``."""
    cosine, sine = np.cos(a[:, 2]), np.sin(a[:, 2])
    x, y = (b - a)[:, 0], (b - a)[:, 1]
    turn = (b[:, 2] - a[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
    return np.stack((cosine * x + sine * y, cosine * y - sine * x, turn), axis=-1)


def drifted(poses: np.ndarray, drift: tuple[float, float, float]) -> np.ndarray:
    """The same way, with an error ``drift`` in each step (m, m, rad)."""
    result = [poses[0]]
    for step in between(poses[:-1], poses[1:]) + drift:
        x, y, yaw = result[-1]
        cosine, sine = math.cos(yaw), math.sin(yaw)
        moved = (x + cosine * step[0] - sine * step[1], y + sine * step[0] + cosine * step[1], yaw + step[2])
        result.append(np.array(moved))
    return np.array(result)
