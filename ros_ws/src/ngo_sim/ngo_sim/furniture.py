"""Furniture and clutter as a 2D lidar sees it: boxes, panels, and the legs of tables, chairs and beds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ngo_sim.convex_shapes import Floats, contains, overlap, rectangle

_LEG_RADIUS_M = (0.015, 0.035)


@dataclass(frozen=True, eq=False)
class Item:
    """One piece of furniture around the origin.

    size_m: length along x and width along y of its footprint. segments_m: (n, 4) x0, y0, x1, y1.
    circles_m: (m, 3) x, y, radius.
    """

    size_m: tuple[float, float]
    segments_m: Floats
    circles_m: Floats

    def placed(self, center: Floats, yaw_rad: float) -> tuple[Floats, Floats]:
        """Its segments and circles with its middle at center, turned by yaw_rad."""
        turn = np.array(((math.cos(yaw_rad), -math.sin(yaw_rad)), (math.sin(yaw_rad), math.cos(yaw_rad))))
        segments = (self.segments_m.reshape(-1, 2, 2) @ turn.T + center).reshape(-1, 4)
        circles = self.circles_m.copy()
        circles[:, :2] = circles[:, :2] @ turn.T + center
        return segments, circles


def outline(polygon: Floats) -> Floats:
    """(n, 4) the edges of a polygon (n, 2)."""
    return np.concatenate((polygon, np.roll(polygon, -1, axis=0)), axis=1)


def box(length_m: float, width_m: float) -> Item:
    """A closed body: a cabinet, a crate, a copier."""
    return Item((length_m, width_m), outline(rectangle((0.0, 0.0), 0.0, length_m, width_m)), np.zeros((0, 3)))


def round_body(radius_m: float) -> Item:
    """A closed cylinder: a bin, a plant, a column."""
    return Item((2 * radius_m, 2 * radius_m), np.zeros((0, 4)), np.array(((0.0, 0.0, radius_m),)))


def table(length_m: float, width_m: float, rng: np.random.Generator) -> Item:
    """A table on four legs."""
    radius = rng.uniform(*_LEG_RADIUS_M)
    corners = rectangle((0.0, 0.0), 0.0, length_m - 0.12, width_m - 0.12)
    circles = np.column_stack((corners, np.full(4, radius)))
    return Item((length_m, width_m), np.zeros((0, 4)), circles)


def desk(length_m: float, width_m: float, rng: np.random.Generator) -> Item:
    """A desk with panels at its sides and its back, or with legs; often with drawers below."""
    if rng.random() < 0.5:
        item = table(length_m, width_m, rng)
        segments, circles = item.segments_m, item.circles_m
    else:
        left, back, right, front = -length_m / 2, width_m / 2, length_m / 2, -width_m / 2 + 0.1
        segments = np.array(((left, front, left, back), (left, back, right, back), (right, back, right, front)))
        circles = np.zeros((0, 3))
    if rng.random() < 0.7:
        side = float(rng.choice((-1.0, 1.0))) * (length_m / 2 - 0.3)
        segments = np.concatenate((segments, outline(rectangle((side, 0.05), 0.0, 0.42, width_m - 0.2))))
    return Item((length_m, width_m), segments, circles)


def chair(rng: np.random.Generator) -> Item:
    """Four legs, or five castors around a column."""
    if rng.random() < 0.4:
        return table(0.55, 0.55, rng)
    angles = rng.uniform(0.0, math.tau) + np.arange(5) * math.tau / 5
    castors = np.column_stack((0.28 * np.cos(angles), 0.28 * np.sin(angles), np.full(5, 0.03)))
    return Item((0.62, 0.62), np.zeros((0, 4)), np.concatenate((castors, ((0.0, 0.0, 0.03),))))


class Placer:
    """Puts items into one room without touching its walls' other side, one another, or what is to stay free.

    room: (n, 2) counter-clockwise convex polygon. clear: convex polygons that stay free.
    """

    def __init__(self, room: Floats, clear: list[Floats], rng: np.random.Generator) -> None:
        self._room, self._clear, self._rng = room, list(clear), rng
        self._items: list[Item] = []
        self._footprints: list[Floats] = []
        self.segments: list[Floats] = []
        self.circles: list[Floats] = []

    def put(self, item: Item, center: Floats, yaw_rad: float, gap_m: float = 0.05) -> bool:
        """Place an item where there is room for it; returns whether there was."""
        footprint = rectangle(center, yaw_rad, *item.size_m)
        if not contains(self._room, footprint, 0.01).all():
            return False
        if any(overlap(footprint, taken, gap_m) for taken in (*self._clear, *self._footprints)):
            return False
        for column, value in zip(self._columns, (item, footprint, *item.placed(center, yaw_rad)), strict=True):
            column.append(value)
        return True

    @property
    def _columns(self) -> tuple[list[Any], ...]:
        """What is known of each item."""
        return self._items, self._footprints, self.segments, self.circles

    def rearrange(self, share: float, rng: np.random.Generator) -> None:
        """Move each item, with the probability ``share``, to a wall or into the room where there is space for it."""
        self._rng = rng
        for index in np.flatnonzero(rng.random(len(self._items)) < share).tolist():
            row = [column.pop(index) for column in self._columns]
            if self.at_wall(row[0]) is not None or self.inside(row[0]):
                row = [column.pop() for column in self._columns]
            for column, value in zip(self._columns, row, strict=True):
                column.insert(index, value)

    def at_wall(self, item: Item, tries: int = 6) -> tuple[Floats, float] | None:
        """Place an item with its back (+y) to some wall; returns its middle and its yaw, None where it fits nowhere."""
        rng = self._rng
        edges = np.roll(self._room, -1, axis=0) - self._room
        lengths = np.hypot(edges[:, 0], edges[:, 1])
        for _ in range(tries):
            edge = int(rng.choice(len(lengths), p=lengths / lengths.sum()))
            if lengths[edge] < item.size_m[0] + 0.1:
                continue
            along = edges[edge] / lengths[edge]
            inward = np.array((-along[1], along[0]))
            where = rng.uniform(item.size_m[0] / 2 + 0.03, lengths[edge] - item.size_m[0] / 2 - 0.03)
            yaw = math.atan2(-along[1], -along[0]) + rng.normal(0.0, 0.015)
            slant = 0.5 * item.size_m[0] * abs(math.sin(yaw - math.atan2(-along[1], -along[0])))
            off = item.size_m[1] / 2 + slant + rng.uniform(0.015, 0.08)
            center = self._room[edge] + along * where + inward * off
            if self.put(item, center, yaw):
                return center, yaw
        return None

    def inside(self, item: Item, yaw_rad: float | None = None, tries: int = 4, gap_m: float = 0.05) -> bool:
        """Place an item somewhere in the room, at any angle where none is given."""
        low, high = self._room.min(axis=0), self._room.max(axis=0)
        for _ in range(tries):
            yaw = self._rng.uniform(0.0, math.tau) if yaw_rad is None else yaw_rad
            if self.put(item, self._rng.uniform(low, high), yaw, gap_m):
                return True
        return False


def furnish_office(placer: Placer, desks: int, rng: np.random.Generator) -> None:
    """Desks with chairs at the walls, shelves, bins and a few loose things."""
    for _ in range(desks):
        spot = placer.at_wall(desk(rng.uniform(1.2, 1.9), rng.uniform(0.65, 0.85), rng))
        if spot is not None and rng.random() < 0.85:
            center, yaw = spot
            front = np.array((math.sin(yaw), -math.cos(yaw)))
            placer.put(chair(rng), center + front * rng.uniform(0.72, 0.95), rng.uniform(0, math.tau), 0.0)
    for _ in range(int(rng.integers(0, 4))):
        placer.at_wall(box(rng.uniform(0.6, 1.8), rng.uniform(0.3, 0.5)))
    for _ in range(int(rng.integers(0, 3))):
        placer.at_wall(round_body(rng.uniform(0.12, 0.22)))
    for _ in range(int(rng.integers(0, 3))):
        placer.inside(chair(rng))
    if rng.random() < 0.4:
        placer.inside(box(rng.uniform(0.25, 0.6), rng.uniform(0.2, 0.45)))


def furnish_open_office(placer: Placer, yaw_rad: float, rng: np.random.Generator) -> None:
    """Islands of desks behind low partitions, as in a laboratory or an open office."""
    for _ in range(int(rng.integers(4, 12))):
        length, width = rng.uniform(1.8, 3.4), rng.uniform(1.3, 1.8)
        legs = rectangle((0.0, 0.0), 0.0, length - 0.15, width - 0.15)
        partition = np.array(((-length / 2, 0.0, length / 2, 0.0), (0.0, -width / 2, 0.0, width / 2)))
        drawers = outline(rectangle((length / 2 - 0.35, width / 4), 0.0, 0.42, 0.5))
        island = Item(
            (length, width),
            np.concatenate((partition[: int(rng.integers(1, 3))], drawers)),
            np.column_stack((legs, np.full(4, 0.03))),
        )
        placer.inside(island, yaw_rad, gap_m=0.8)
    for _ in range(int(rng.integers(4, 14))):
        placer.inside(chair(rng), tries=2, gap_m=0.0)
    for _ in range(int(rng.integers(2, 7))):
        placer.at_wall(box(rng.uniform(0.6, 2.5), rng.uniform(0.3, 0.6)))


def furnish_meeting(placer: Placer, yaw_rad: float, rng: np.random.Generator) -> None:
    """A big table with chairs around it."""
    length, width = rng.uniform(1.8, 4.0), rng.uniform(1.0, 1.4)
    if placer.inside(table(length, width, rng), yaw_rad, tries=8):
        for _ in range(int(rng.integers(4, 12))):
            placer.inside(chair(rng), tries=2, gap_m=0.0)
    placer.at_wall(box(rng.uniform(1.0, 2.2), rng.uniform(0.35, 0.5)))
    if rng.random() < 0.5:
        placer.at_wall(round_body(rng.uniform(0.15, 0.25)))


def furnish_storage(placer: Placer, rng: np.random.Generator) -> None:
    """Shelves at the walls, and crates and pallets at any angle."""
    for _ in range(int(rng.integers(2, 7))):
        placer.at_wall(box(rng.uniform(0.8, 2.5), rng.uniform(0.35, 0.7)))
    for _ in range(int(rng.integers(3, 12))):
        placer.inside(box(rng.uniform(0.2, 1.2), rng.uniform(0.2, 0.9)))
    for _ in range(int(rng.integers(0, 4))):
        placer.inside(round_body(rng.uniform(0.1, 0.35)))


def furnish_hall(placer: Placer, rng: np.random.Generator) -> None:
    """Columns, benches, plants and a counter."""
    square = rng.random() < 0.4
    size = rng.uniform(0.15, 0.4)
    for _ in range(int(rng.integers(2, 9))):
        placer.inside(box(2 * size, 2 * size) if square else round_body(size), 0.0 if square else None)
    for _ in range(int(rng.integers(1, 6))):
        placer.at_wall(box(rng.uniform(1.0, 2.5), rng.uniform(0.35, 0.6)))
    for _ in range(int(rng.integers(0, 5))):
        placer.at_wall(round_body(rng.uniform(0.15, 0.35)))
    for _ in range(int(rng.integers(0, 5))):
        placer.inside(table(rng.uniform(0.7, 1.2), rng.uniform(0.7, 0.9), rng))
    if rng.random() < 0.4:
        placer.inside(box(rng.uniform(2.0, 3.5), rng.uniform(0.6, 0.9)))
