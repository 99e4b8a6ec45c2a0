"""Rooms of straight walls and the exact ranges that a scanner measures in them."""

import math

import numpy as np

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import Array, compose
from ngo_estimator.geometry.scan_points import Mounting, key_scan

L_ROOM = ((0.0, 0.0), (8.0, 0.0), (8.0, 3.0), (4.0, 3.0), (4.0, 6.0), (0.0, 6.0))
PILLAR = ((1.2, 3.8), (1.6, 3.8), (1.6, 4.3), (1.2, 4.3))
CORRIDOR = ((-200.0, -1.0), (200.0, -1.0), (200.0, 1.0), (-200.0, 1.0))
MAX_RANGE = 30.0


def walls(*outlines: tuple[tuple[float, float], ...]) -> Array:
    """Segments ``(n, 2, 2)`` of closed outlines."""
    parts = [np.stack((np.array(part), np.roll(np.array(part), -1, axis=0)), axis=1) for part in outlines]
    return np.concatenate(parts)


ROOM = walls(L_ROOM, PILLAR)
HALLWAY = walls(CORRIDOR)


def cast(segments: Array, sensor: Array, angles: Array) -> Array:
    """Ranges ``(m,)`` of a sensor at a pose ``(3,)`` along angles ``(m,)``; infinite without a wall."""
    direction = np.stack((np.cos(angles + sensor[2]), np.sin(angles + sensor[2])), axis=-1)[:, None]
    start, along = segments[:, 0] - sensor[:2], segments[:, 1] - segments[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = direction[..., 0] * along[:, 1] - direction[..., 1] * along[:, 0]
        distance = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / determinant
        share = (start[:, 0] * direction[..., 1] - start[:, 1] * direction[..., 0]) / determinant
    hit = (distance > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(hit, distance, np.inf).min(axis=-1)


def fan(rays: int = 181, degrees: float = 180.0) -> Array:
    """Angles ``(rays,)`` of a scanner that looks ahead; all around where it has 360 degrees."""
    half = math.radians(degrees) / 2.0
    return np.linspace(-half, half, rays, endpoint=degrees < 360.0)


def scan_at(
    segments: Array,
    base: Array,
    stamp_ns: int = 0,
    angles: Array | None = None,
    mounting: Mounting | None = None,
    noise: tuple[float, np.random.Generator] | None = None,
) -> KeyScan:
    """The scan of a robot whose base has the pose ``(3,)``, with normal noise (m) on its ranges."""
    angles = fan() if angles is None else angles
    mounting = mounting or Mounting(np.zeros(3))
    sign = -1.0 if mounting.upside_down else 1.0
    ranges = cast(segments, compose(base, mounting.sensor_xyyaw), sign * angles)
    if noise is not None:
        ranges = ranges + noise[0] * noise[1].standard_normal(len(ranges))
    return key_scan(stamp_ns, angles, ranges, (0.05, MAX_RANGE), mounting)


def round_trip(steps: int, period: int = 80) -> Array:
    """Poses ``(steps, 3)`` of a robot that drives along an ellipse in the room, from the origin's turn on."""
    phase = 2.0 * math.pi * np.arange(steps) / period
    x, y = 2.2 + 1.2 * np.sin(phase), 1.9 - 0.9 * np.cos(phase)
    return np.stack((x, y, np.arctan2(0.9 * np.sin(phase), 1.2 * np.cos(phase))), axis=-1)
