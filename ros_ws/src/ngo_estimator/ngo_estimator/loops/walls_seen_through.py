"""Walls that a scanner looked through: evidence that scans are not where they were put."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import Array, compose, rotated, transformed

PROFILE_BINS = 360
"""Directions of a range profile."""

_MARGIN_M, _MARGIN_SHARE = 0.3, 0.02  # a ray that goes on for that much behind a point went through it


@dataclass(frozen=True, eq=False)
class PlacedScans:
    """Scans placed in one frame.

    ``points`` and ``normals`` ``(n, 2)`` of all scans, in that frame; ``sensors`` ``(scans, 3)`` the sensors' poses
    in it; ``profiles`` ``(scans, 360)`` the range in each direction from a sensor (m, 0 where unknown), direction ``k``
    from ``k`` degrees on.
    """

    points: Array
    normals: Array
    sensors: Array
    profiles: Array


def range_profile(scan: KeyScan) -> Array:
    """Least range ``(360,)`` within a degree of each direction from the sensor (m, 0 where no ray came back)."""
    profile: Array = _profile(scan.angles, scan.ranges)
    return profile


def profile_rays(profile: Array) -> tuple[Array, Array]:
    """Directions and ranges ``(360,)`` of rays that have this range profile again."""
    seen = np.where(profile > 0.0, profile, np.inf)
    ranges: Array = np.maximum(seen, np.maximum(np.roll(seen, 1), np.roll(seen, -1)))
    angles: Array = (np.arange(PROFILE_BINS, dtype=np.float64) + 0.5) * (2.0 * math.pi / PROFILE_BINS)
    return angles, ranges


@njit(cache=True)
def _profile(angles: Array, ranges: Array) -> Array:
    nearest = np.full(PROFILE_BINS, np.inf)
    for k in range(len(ranges)):
        if not math.isfinite(ranges[k]):
            continue
        direction = math.floor(angles[k] * (PROFILE_BINS / (2.0 * math.pi)))
        for neighbour in range(direction - 1, direction + 2):
            nearest[neighbour % PROFILE_BINS] = min(nearest[neighbour % PROFILE_BINS], ranges[k])
    return np.where(np.isfinite(nearest), nearest, 0.0)


def placed(scans: Sequence[KeyScan], profiles: Sequence[Array], poses: Array) -> PlacedScans:
    """Scans and their range profiles at poses ``(scans, 3)`` of their base in one frame."""
    points, normals = np.concatenate([scan.points for scan in scans]), np.concatenate([scan.normals for scan in scans])
    ends = np.cumsum([len(scan.points) for scan in scans])
    sensors = np.stack([scan.sensor_xyyaw for scan in scans])
    return PlacedScans(*_placed(points, normals, ends, sensors, poses), np.array(profiles, np.float64))


@njit(cache=True)
def _placed(
    points: Array, normals: Array, ends: NDArray[np.int64], sensors: Array, poses: Array
) -> tuple[Array, Array, Array]:
    """Points and normals ``(n, 2)``, those of each scan up to its end, and sensors at the poses of the scans."""
    at, facing, where = np.empty_like(points), np.empty_like(normals), np.empty_like(sensors)
    begin = 0
    for k in range(len(ends)):
        at[begin : ends[k]] = transformed(poses[k], points[begin : ends[k]])
        facing[begin : ends[k]] = rotated(poses[k, 2], normals[begin : ends[k]])
        where[k] = compose(poses[k], sensors[k])
        begin = ends[k]
    return at, facing, where


def seen_through(target: PlacedScans, source: PlacedScans, pose: Array) -> float:
    """Share of sightings that go through a wall: points of one side, from all sensors of the other.

    A sighting is a point that a sensor should have seen: a ray in its direction ends there or goes on behind it. Points
    behind the end of a ray are hidden, and say nothing. A wall that one side alone has is seen through by the other
    alone, so that the larger of the two shares is returned; one where there is no sighting at all. ``pose`` ``(3,)`` is
    that of ``source`` in ``target``.
    """
    sensors = np.stack([compose(pose, sensor) for sensor in source.sensors])
    both = (
        sightings(target.sensors, target.profiles, transformed(pose, source.points)).sum(0),
        sightings(sensors, source.profiles, target.points).sum(0),
    )
    return max((through / (through + on) for through, on in both if through + on > 0), default=1.0)


@njit(cache=True)
def sightings(sensors: Array, profiles: Array, points: Array) -> NDArray[np.int64]:
    """How many of the sensors ``(s, 3)`` see through each point, and how many see it ``(n, 2)``."""
    seen = np.zeros((len(points), 2), np.int64)
    bins = profiles.shape[1]
    for s in range(len(sensors)):
        farthest = (profiles[s].max() + _MARGIN_M) / (1.0 - _MARGIN_SHARE)
        for k in range(len(points)):
            x, y = points[k, 0] - sensors[s, 0], points[k, 1] - sensors[s, 1]
            away = math.sqrt(x * x + y * y)
            if away > farthest:
                continue
            direction = math.floor((math.atan2(y, x) - sensors[s, 2]) * bins / (2.0 * math.pi)) % bins
            ray = profiles[s, direction]
            if ray > 0.0:
                margin = _MARGIN_M + _MARGIN_SHARE * away
                if away < ray - margin:
                    seen[k, 0] += 1
                elif away < ray + margin:
                    seen[k, 1] += 1
    return seen
