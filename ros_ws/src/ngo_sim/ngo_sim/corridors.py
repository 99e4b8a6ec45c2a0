"""Networks of corridors: rings, wings off a spine, arcs, halls with corridors at uneven angles, and ladders."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ngo_sim.convex_shapes import Floats, counter_clockwise

# Pieces of a corridor reach into one another by this much, so no wall stands between them.
_SEAM_M = 1e-3


@dataclass(frozen=True, eq=False)
class Corridor:
    """A corridor along a polyline.

    points: (n, 2), m; a closed one returns from its last point to its first. width_m: from wall to wall.
    """

    points: Floats
    width_m: float
    closed: bool = False

    def stations(self) -> Floats:
        """(n, 2) the polyline's points, the first one again at the end of a closed one."""
        return np.concatenate((self.points, self.points[:1])) if self.closed else self.points

    def quads(self) -> list[Floats]:
        """A convex, counter-clockwise quadrilateral (4, 2) for each straight piece, mitred at the bends."""
        points = self.stations()
        delta = np.diff(points, axis=0)
        along = delta / np.hypot(delta[:, 0], delta[:, 1])[:, None]
        normal = np.stack((-along[:, 1], along[:, 0]), axis=1)
        before, after = np.concatenate((normal[:1], normal)), np.concatenate((normal, normal[-1:]))
        if self.closed:
            before[0], after[-1] = normal[-1], normal[0]
        mitre = before + after
        mitre /= np.maximum(np.sum(mitre * before, axis=1), 0.2)[:, None]
        left, right = points + mitre * self.width_m / 2, points - mitre * self.width_m / 2
        seam = along * _SEAM_M
        return [
            counter_clockwise(
                np.array((right[i] - seam[i], right[i + 1] + seam[i], left[i + 1] + seam[i], left[i] - seam[i]))
            )
            for i in range(len(delta))
        ]

    @property
    def length_m(self) -> float:
        """Length along the middle."""
        return float(np.hypot(*np.diff(self.stations(), axis=0).T).sum())

    def at(self, along_m: float) -> tuple[Floats, Floats]:
        """The middle's point (2,) at a distance from its start, and the unit direction (2,) there."""
        points = self.stations()
        delta = np.diff(points, axis=0)
        lengths = np.hypot(delta[:, 0], delta[:, 1])
        reached = np.concatenate(((0.0,), np.cumsum(lengths)))
        piece = int(np.clip(np.searchsorted(reached, along_m, side="right") - 1, 0, len(lengths) - 1))
        direction = delta[piece] / lengths[piece]
        return points[piece] + direction * (along_m - reached[piece]), direction


@dataclass(frozen=True, eq=False)
class Layout:
    """Corridors that are joined, and halls (convex polygons, counter-clockwise) on their way."""

    corridors: list[Corridor]
    halls: list[Floats] = field(default_factory=list)


def _width(rng: np.random.Generator) -> float:
    return float(rng.uniform(1.6, 3.0))


def _ray(start: Floats, yaw_rad: float, length_m: float) -> Floats:
    return np.array((start, start + length_m * np.array((math.cos(yaw_rad), math.sin(yaw_rad)))))


def ring(rng: np.random.Generator, scale: float) -> Layout:
    """Four corridors around a block, hardly any at a right angle, with a shortcut and stubs."""
    length, depth = scale * rng.uniform(24, 48), scale * rng.uniform(16, 32)
    corners = np.array(((0, 0), (length, 0), (length, depth), (0, depth)), dtype=np.float64)
    corners += rng.normal(0.0, 0.09, (4, 2)) * depth
    corridors = [Corridor(corners, _width(rng), closed=True)]
    if rng.random() < 0.6:
        a, b = rng.uniform(0.3, 0.7, 2)
        ends = np.array((corners[0] + a * (corners[1] - corners[0]), corners[3] + b * (corners[2] - corners[3])))
        corridors.append(Corridor(ends, _width(rng)))
    for side in range(4):
        if rng.random() < 0.5:
            begin, end = corners[side], corners[(side + 1) % 4]
            outward = math.atan2(*(end - begin)[::-1]) - math.pi / 2 + rng.normal(0.0, 0.25)
            start = begin + rng.uniform(0.1, 0.9) * (end - begin)
            corridors.append(Corridor(_ray(start, outward, scale * rng.uniform(8, 22)), 1.6))
    return Layout(corridors)


def wings(rng: np.random.Generator, scale: float) -> Layout:
    """A bent spine with branches; two branches of a side may be joined to a loop."""
    first, second = scale * rng.uniform(16, 34, 2)
    bend = rng.uniform(0.25, 1.0) * rng.choice((-1.0, 1.0))
    turn = np.array((math.cos(bend), math.sin(bend)))
    spine = np.array(((0.0, 0.0), (first, 0.0), (first + second * turn[0], second * turn[1])))
    corridors = [Corridor(spine, rng.uniform(2.0, 3.2))]
    for side in (-1.0, 1.0):
        ends = []
        for where in (rng.uniform(0.04, 0.2), rng.uniform(0.7, 0.96)):
            if rng.random() < 0.85:
                start, direction = corridors[0].at(where * (first + second))
                angle = math.pi / 2 if rng.random() < 0.5 else rng.uniform(1.1, 2.0)
                yaw = math.atan2(direction[1], direction[0]) + side * angle
                branch = Corridor(_ray(start, yaw, scale * rng.uniform(11, 24)), float(rng.uniform(1.6, 2.0)))
                corridors.append(branch)
                ends.append(branch.points[0] + 0.9 * (branch.points[1] - branch.points[0]))
        if len(ends) == 2 and rng.random() < 0.7:
            corridors.append(Corridor(np.array(ends), 1.6))
    return Layout(corridors)


def arc(rng: np.random.Generator, scale: float) -> Layout:
    """A curved corridor whose ends a straight one joins, with branches outward."""
    radius, sweep = scale * rng.uniform(14, 26), rng.uniform(1.8, 3.6)
    angles = np.linspace(0.0, sweep, max(8, int(radius * sweep)))
    points = radius * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    corridors = [Corridor(points, _width(rng)), Corridor(points[[-1, 0]], _width(rng))]
    for angle in rng.uniform(0.15, 0.85, int(rng.integers(1, 4))) * sweep:
        start = radius * np.array((math.cos(angle), math.sin(angle)))
        corridors.append(Corridor(_ray(start, angle + rng.normal(0.0, 0.2), scale * rng.uniform(8, 20)), 1.6))
    return Layout(corridors)


def hall(rng: np.random.Generator, scale: float) -> Layout:
    """A round or polygonal hall with corridors at uneven angles, two of them joined."""
    sides = int(rng.choice((5, 6, 8, 40)))
    radius = rng.uniform(5.0, 9.0)
    around = (
        np.sort(rng.uniform(-0.2, 0.2, sides) + np.arange(sides) * 2 * math.pi / sides)
        if sides < 40
        else (np.arange(sides) * 2 * math.pi / sides)
    )
    polygon = radius * np.stack((np.cos(around), np.sin(around)), axis=1)
    count = int(rng.integers(3, 6))
    yaws = np.arange(count) * 2 * math.pi / count + rng.uniform(-0.3, 0.3, count)
    center = np.zeros(2)
    corridors = [
        Corridor(_ray(center, float(yaw), radius + scale * rng.uniform(12, 28)), float(rng.uniform(1.8, 2.8)))
        for yaw in yaws
    ]
    first = int(rng.integers(count))
    for one in (first, (first + 1) % count)[: int(rng.integers(1, 3))]:
        ends = [corridors[k].points[1] * rng.uniform(0.75, 0.95) for k in (one, (one + 1) % count)]
        corridors.append(Corridor(np.array(ends), 1.6))
    return Layout(corridors, [polygon])


def ladder(rng: np.random.Generator, scale: float) -> Layout:
    """Equal wings between two equal spines, evenly spaced: every place looks like several others."""
    count, pitch, depth = int(rng.integers(3, 6)), rng.uniform(11.0, 14.0), scale * rng.uniform(18, 30)
    width, last = float(rng.uniform(1.8, 2.6)), 0.0
    last = pitch * (count - 1)
    corridors = [Corridor(np.array(((0.0, 0.0), (last, 0.0), (last, depth), (0.0, depth))), width, closed=True)]
    for wing in range(1, count - 1):
        corridors.append(Corridor(np.array(((wing * pitch, 0.0), (wing * pitch, depth))), width))
    return Layout(corridors)


LAYOUTS: dict[str, Callable[[np.random.Generator, float], Layout]] = {
    "ring": ring,
    "wings": wings,
    "arc": arc,
    "hall": hall,
    "ladder": ladder,
}
"""Layouts by name; each takes a generator and a factor for its size."""
