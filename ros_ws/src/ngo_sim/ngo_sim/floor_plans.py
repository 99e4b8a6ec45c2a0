"""Seeded floor plans of buildings at the height of a lidar: walls, doors, furniture, glass and columns.

Free space is a union of convex polygons: corridors, rooms, doorways, alcoves. Walls are the boundary of that union.
Lanes from every corridor through every passable door into every room stay free of furniture, so a plan is connected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ngo_common.settings import Settings, setting
from ngo_sim.convex_shapes import Floats, counter_clockwise, lane, overlap, rectangle, union_walls
from ngo_sim.corridors import LAYOUTS, Corridor, Layout
from ngo_sim.furniture import (
    Item,
    Placer,
    box,
    furnish_hall,
    furnish_meeting,
    furnish_office,
    furnish_open_office,
    furnish_storage,
    round_body,
)

LANE_WIDTH_M = 0.9
_DOOR_EPOCHS = 32
_MOVED_SHARE = 0.05
_MARGIN_M = 2.0


@dataclass(frozen=True)
class FloorPlanConfig(Settings):
    """What kind of building is drawn."""

    layout: str = setting(
        "any", "Shape of the network of corridors; any: drawn from the seed.", choices=("any", *LAYOUTS)
    )
    scale: float = setting(
        1.0, "Factor on the length of the corridors. Rooms keep their size.", minimum=0.3, maximum=3.0
    )
    aliased: bool = setting(False, "Whether rooms along the corridors look alike, furniture included.")
    glass: float = setting(
        0.12, "Share of the rooms with a glass front. Twice that share have windows.", minimum=0.0, maximum=0.5
    )
    clutter: float = setting(
        1.0, "Amount of furniture and of objects in corridors; 0: empty rooms, 1: usual.", minimum=0.0, maximum=2.0
    )
    furniture_moves: int = setting(
        0,
        "How many times furniture of rooms and halls was moved, each time one piece in twenty, within its room.",
        minimum=0,
        maximum=1000,
    )
    people: int = setting(3, "Number of people who walk from room to room.", minimum=0, maximum=50)
    plan: str = setting(
        "",
        "YAML file of a map server's map, whose walls are the building's. What is drawn is then only people and goals. "
        "Empty: a drawn building.",
    )


@dataclass(frozen=True, eq=False)
class Doors:
    """Door leaves that turn on hinges.

    hinges_m: (n, 2). closed_rad: (n,) direction from the hinge along the closed leaf. turn: (n,) +1 or -1, the sense
    in which it opens. widths_m: (n,). angles_rad: (n, 32) opening in each of 32 epochs, over and over. periods_s,
    phases_s: (n,) length of an epoch, and how far the first one has gone at time 0. passable: (n,) whether the door
    never leaves the robot's way blocked.
    """

    hinges_m: Floats
    closed_rad: Floats
    turn: Floats
    widths_m: Floats
    angles_rad: Floats
    periods_s: Floats
    phases_s: Floats
    passable: npt.NDArray[np.bool_]

    def leaves(self, times_s: Floats) -> Floats:
        """(times, n, 4) the leaves as segments x0, y0, x1, y1 at some times."""
        return self.leaves_at(self.opened_rad(times_s))

    def opened_rad(self, times_s: Floats) -> Floats:
        """(times, n) the angles by which they are opened at some times."""
        epochs = np.floor((np.asarray(times_s)[:, None] + self.phases_s) / self.periods_s).astype(np.int64)
        return np.asarray(self.angles_rad[np.arange(len(self.hinges_m)), epochs % _DOOR_EPOCHS])

    def leaves_at(self, opened_rad: Floats) -> Floats:
        """(k, n, 4) the leaves as segments where they are opened by angles (k, n)."""
        yaw = self.closed_rad + self.turn * opened_rad
        hinges = np.broadcast_to(self.hinges_m, (*yaw.shape, 2))
        tips = hinges + self.widths_m[:, None] * np.stack((np.cos(yaw), np.sin(yaw)), axis=-1)
        return np.concatenate((hinges, tips), axis=-1)


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A building. Its frame has its origin below and left of it, x and y along no wall in particular.

    segments_m: (n, 4) x0, y0, x1, y1 of walls and furniture. glass: (n,) which of them are glass. circles_m: (m, 3)
    x, y, radius. goals_m: (g, 2) points that the robot can reach: one a passable room, and some in corridors.
    frame_xyyaw: pose of this frame in that of the file that the plan was read from.
    """

    segments_m: Floats
    glass: npt.NDArray[np.bool_]
    circles_m: Floats
    doors: Doors
    goals_m: Floats
    layout: str
    frame_xyyaw: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the area around the building."""
        high = self.segments_m.reshape(-1, 2).max(axis=0) + _MARGIN_M
        return float(high[0]), float(high[1])

    def in_file(self, pose_xyyaw: Floats) -> Floats:
        """(3,) a pose of this frame in that of the file; the same pose where the plan was drawn."""
        x, y, yaw = self.frame_xyyaw
        cos, sin = math.cos(yaw), math.sin(yaw)
        turned = (cos * pose_xyyaw[0] - sin * pose_xyyaw[1], sin * pose_xyyaw[0] + cos * pose_xyyaw[1])
        return np.array((x + turned[0], y + turned[1], pose_xyyaw[2] + yaw))


class _Builder:
    """Collects the polygons and the contents of one building."""

    def __init__(self, seed: int, config: FloorPlanConfig, layout: Layout, rng: np.random.Generator) -> None:
        self.seed, self.config, self.rng = seed, config, rng
        self.polygons: list[Floats] = []
        self.glass_edges: list[tuple[int, ...]] = []
        self.lanes: list[Floats] = []
        self.goals: list[Floats] = []
        self.panes: list[Floats] = []  # glass that stands free in an opening, (4,)
        self.segments: list[Floats] = []
        self.circles: list[Floats] = []
        self.doors: list[tuple[Floats, float, float, float, Floats, float, float, bool]] = []
        self._placers: list[tuple[int, int, Placer]] = []  # with the first of its segments and circles
        self._solid: list[Floats] = []  # rooms, corridors and halls: what a new room must keep off
        for corridor in layout.corridors:
            for quad in corridor.quads():
                self._add(quad)
            stations = corridor.stations()
            self.lanes += [lane(a, b, LANE_WIDTH_M) for a, b in zip(stations[:-1], stations[1:], strict=True)]
            for along in np.arange(2.0, corridor.length_m - 1.0, 9.0):
                self.goals.append(corridor.at(float(along))[0])
        for polygon in layout.halls:
            self._add(counter_clockwise(polygon))
        self._layout = layout

    def _add(self, polygon: Floats, glass_edges: tuple[int, ...] = (), solid: bool = True) -> None:
        self.polygons.append(polygon)
        self.glass_edges.append(glass_edges)
        if solid:
            self._solid.append(polygon)

    def _free(self, polygon: Floats, margin_m: float) -> bool:
        middle = polygon.mean(axis=0)
        reach = np.hypot(*(polygon - middle).T).max() + margin_m
        for other in self._solid:
            other_middle = other.mean(axis=0)
            if np.hypot(*(other_middle - middle)) < reach + np.hypot(*(other - other_middle).T).max() and overlap(
                polygon, other, margin_m
            ):
                return False
        return True

    def build(self) -> None:
        """Rooms along all corridors, then what stands in halls and corridors."""
        wall_m = float(self.rng.uniform(0.1, 0.28))
        templates = int(self.rng.integers(1, 3))
        number = 0
        for corridor in self._layout.corridors:
            for side in (-1.0, 1.0):
                along, previous = 0.3, None
                while along < corridor.length_m - 2.0:
                    number += 1
                    # Rooms of one template are drawn from generators of the same seed, so they are equal.
                    key = number % templates if self.config.aliased else number
                    room = self._room(corridor, along, side, wall_m, np.random.default_rng((self.seed, 1, key)))
                    if room is None:
                        along, previous = along + 0.7, None
                        continue
                    polygon, width = room
                    if previous is not None and self.rng.random() < 0.15:
                        self._join(previous, polygon, wall_m)
                    along, previous = along + width + wall_m, polygon
        self._alcoves()
        for polygon in self._layout.halls:
            furnish_hall(placer := Placer(polygon, self.lanes, self.rng), self.rng)
            self._take(placer)
        self._corridor_clutter()
        self._rearrange()

    def _room(
        self, corridor: Corridor, along: float, side: float, wall_m: float, rng: np.random.Generator
    ) -> tuple[Floats, float] | None:
        """Add a room with its door and furniture; its polygon and width, None where there is no space."""
        kind = str(rng.choice(("office", "office", "office", "open", "meeting", "storage", "storage")))
        width = float(rng.uniform(6.0, 12.0) if kind == "open" else rng.uniform(2.4, 6.0))
        depth = float(rng.uniform(6.0, 10.0) if kind == "open" else rng.uniform(2.8, 6.5))
        slant, bulge = rng.normal(0.0, 0.35), float(rng.uniform(0.5, 1.5)) if rng.random() < 0.08 else 0.0
        slanted = rng.random() < 0.15 and bulge == 0.0
        width = min(width, corridor.length_m - along - 0.2)
        (a, tangent_a), (b, tangent_b) = corridor.at(along), corridor.at(along + width)
        a, b = (p + side * np.array((-t[1], t[0])) * corridor.width_m / 2 for p, t in ((a, tangent_a), (b, tangent_b)))
        middle, tangent = corridor.at(along + width / 2)
        at_wall = middle + side * np.array((-tangent[1], tangent[0])) * corridor.width_m / 2
        # Around a bend the front would be far from the corridor, and the door would lead nowhere.
        if np.hypot(*(at_wall - (a + b) / 2)) > 0.2:
            return None
        front = b - a
        width = float(np.hypot(*front))
        if width < 2.2:
            return None
        u = front / width
        out = side * np.array((-u[1], u[0]))
        # Along a curve the chord cuts into the corridor: push the room outward until it does not.
        for push in (0.0, 0.1, 0.2, 0.35):
            for shrink in (1.0, 0.75, 0.5):
                reach = depth * shrink
                lower = wall_m + push
                back_a, back_b = (reach + slant, reach - slant) if slanted else (reach, reach)
                corners = [(0.0, lower), (width, lower), (width, lower + back_b)]
                if bulge > 0.0:
                    steps = np.linspace(0.0, math.pi, 12)[1:-1]
                    corners += [
                        (width / 2 + width / 2 * math.cos(t), lower + reach + bulge * math.sin(t)) for t in steps
                    ]
                corners.append((0.0, lower + back_a))
                local = np.array(corners)
                polygon = counter_clockwise(a + local[:, :1] * u + local[:, 1:] * out)
                if reach >= 2.4 and self._free(polygon, 0.95 * min(wall_m, 0.1)):
                    self._add(polygon)
                    self._entrance(polygon, a, u, out, width, lower, reach, kind, rng)
                    self._windows(polygon, rng)
                    return polygon, width
        return None

    def _entrance(
        self,
        polygon: Floats,
        a: Floats,
        u: Floats,
        out: Floats,
        width: float,
        lower: float,
        reach: float,
        kind: str,
        rng: np.random.Generator,
    ) -> None:
        """The doorway, its leaf, a glass front, and the furniture behind it."""
        door_m = float(min(rng.uniform(0.95, 1.15) if kind != "open" else rng.uniform(1.0, 1.4), width - 0.7))
        where = float(rng.uniform(door_m / 2 + 0.15, width - door_m / 2 - 0.15))
        passable, leaf, frame = rng.random() < 0.65, rng.random() < 0.85, rng.uniform(0.0, 0.8)
        middle = a + where * u
        yaw = math.atan2(out[1], out[0])
        self._add(rectangle(middle + out * (lower / 2), yaw, lower + 0.5, door_m), solid=False)
        # An open leaf reaches door_m into the room: ways bend behind it.
        inside_y = max(float(rng.uniform(0.45, 0.75)) * reach, door_m + 0.5)
        inside_x = float(np.clip(rng.uniform(0.25, 0.75) * width, 0.7, width - 0.7))
        goal = a + inside_x * u + (lower + inside_y) * out
        threshold = middle + (lower + door_m + 0.45) * out
        clear = [lane(middle - 0.8 * out, threshold, LANE_WIDTH_M), lane(threshold, goal, LANE_WIDTH_M)]
        if leaf or not passable:
            end = float(rng.choice((-1.0, 1.0)))
            hinge = middle + end * u * (door_m / 2) + out * (lower if passable else lower * frame)
            sense = -end * math.copysign(1.0, u[0] * out[1] - u[1] * out[0])
            free_m = where - door_m / 2 if end < 0 else width - where - door_m / 2
            widest = math.radians(165 if free_m > door_m + 0.1 else 92)
            # A passable door never stands in the way; behind another one nobody drives.
            opened = rng.uniform(math.radians(88), widest, _DOOR_EPOCHS)
            if not passable:
                opened = np.where(rng.random(_DOOR_EPOCHS) < 0.75, 0.0, rng.uniform(0.0, widest, _DOOR_EPOCHS))
            period = float(rng.uniform(60.0, 400.0))
            closed = math.atan2(*(-end * u)[::-1])
            door = (hinge, closed, sense, door_m - 0.02, opened, period, float(rng.uniform(0, period)), passable)
            self.doors.append(door)
            swing = hinge + out * door_m / 2
            clear.append(rectangle(swing, math.atan2(u[1], u[0]), 2 * door_m, door_m))
        if passable:
            self.goals.append(goal)
            self.lanes += clear[:2]
        if rng.random() < self.config.glass:
            self._glass_front(a, u, out, width, lower, where, door_m)
        if rng.random() >= self.config.clutter:
            return
        placer = Placer(polygon, clear, rng)
        along = math.atan2(u[1], u[0])
        if kind == "office":
            furnish_office(placer, max(1, int(rng.integers(1, 4) * self.config.clutter)), rng)
        elif kind == "open":
            furnish_open_office(placer, along, rng)
        elif kind == "meeting":
            furnish_meeting(placer, along, rng)
        else:
            furnish_storage(placer, rng)
        self._take(placer)

    def _glass_front(
        self, a: Floats, u: Floats, out: Floats, width: float, lower: float, where: float, door_m: float
    ) -> None:
        for begin, end in ((0.15, where - door_m / 2 - 0.1), (where + door_m / 2 + 0.1, width - 0.15)):
            if end - begin > 0.5:
                middle = a + u * (begin + end) / 2 + out * lower / 2
                self._add(rectangle(middle, math.atan2(out[1], out[0]), lower + 0.02, end - begin), solid=False)
                self.panes.append(np.concatenate((middle - u * (end - begin) / 2, middle + u * (end - begin) / 2)))

    def _windows(self, polygon: Floats, rng: np.random.Generator) -> None:
        """Panes in the wall at the back, flush with its outer side."""
        if rng.random() >= 2 * self.config.glass:
            return
        begin, end = polygon[2], polygon[3]
        length = float(np.hypot(*(end - begin)))
        along = (end - begin) / max(length, 1e-9)
        for where in np.arange(0.8, length - 0.7, 1.6):
            middle = begin + along * where
            frame = rectangle(middle, math.atan2(along[1], along[0]), 1.2, 0.24)
            outside = -np.array((-along[1], along[0]))
            if self._free(frame + outside * 0.16, 0.05):
                self._add(frame, glass_edges=(0,), solid=False)

    def _join(self, first: Floats, second: Floats, wall_m: float) -> None:
        """An opening between two neighbouring rooms, where nothing stands in it."""
        one, other = first.mean(axis=0), second.mean(axis=0)
        yaw = math.atan2(*(other - one)[::-1])
        middle = _middle_between(first, second)
        passage = rectangle(middle, yaw, wall_m + 0.7, 1.0)
        things = [s for part in self.segments[-2:] for s in part]
        if all(not overlap(passage, np.reshape(s, (2, 2)), 0.3) for s in things):
            self._add(passage, solid=False)

    def _alcoves(self) -> None:
        """Recesses in the corridors' walls, some filled by a cabinet."""
        for corridor in self._layout.corridors:
            for along in np.arange(1.0, corridor.length_m - 1.0, 1.5):
                for side in (-1.0, 1.0):
                    if self.rng.random() > 0.3:
                        continue
                    point, tangent = corridor.at(float(along))
                    out = side * np.array((-tangent[1], tangent[0]))
                    deep, wide = self.rng.uniform(0.2, 1.3), self.rng.uniform(0.5, 2.2)
                    middle = point + out * (corridor.width_m / 2 + deep / 2)
                    yaw = math.atan2(out[1], out[0])
                    if self._free(rectangle(middle + out * 0.1, yaw, deep - 0.15, wide), 0.04):
                        self._add(rectangle(middle - out * 0.1, yaw, deep + 0.2, wide), solid=False)
                        self._solid.append(rectangle(middle, yaw, deep, wide))

    def _corridor_clutter(self) -> None:
        """Door frames across, pilasters, radiators, cabinets, benches, bins and plants along the walls."""
        rng = self.rng
        openings = self.lanes + [
            p for p in self.polygons if len(p) == 4 and _short_side(p) < 2.0 and _long_side(p) < 2.2
        ]
        for corridor in self._layout.corridors:
            half = corridor.width_m / 2
            for along in np.arange(0.5, corridor.length_m - 0.5, 0.8 / max(self.config.clutter, 0.05)):
                if rng.random() > 0.5:
                    continue
                point, tangent = corridor.at(float(along + rng.uniform(0.0, 0.8)))
                left, yaw = np.array((-tangent[1], tangent[0])), math.atan2(tangent[1], tangent[0])
                frame = rng.random() < 0.12
                item = _frame_post(half, rng) if frame else _at_corridor_wall(half, rng)
                for side in (-1.0, 1.0) if frame else (float(rng.choice((-1.0, 1.0))),):
                    center = point + side * left * (half - item.size_m[1] / 2 - (0.0 if frame else 0.02))
                    footprint = rectangle(center, yaw, *item.size_m)
                    if any(overlap(footprint, other, 0.02) for other in openings):
                        continue
                    openings.append(footprint)
                    segments, circles = item.placed(center, yaw + (0.0 if frame else rng.normal(0.0, 0.03)))
                    self.segments.append(segments)
                    self.circles.append(circles)

    def _take(self, placer: Placer) -> None:
        self._placers.append((len(self.segments), len(self.circles), placer))
        self.segments += placer.segments
        self.circles += placer.circles

    def _rearrange(self) -> None:
        """Move furniture as often as the settings say; more moves begin with the same ones."""
        for move in range(self.config.furniture_moves):
            rng = np.random.default_rng((self.seed, 4, move))
            for segment, circle, placer in self._placers:
                placer.rearrange(_MOVED_SHARE, rng)
                self.segments[segment : segment + len(placer.segments)] = placer.segments
                self.circles[circle : circle + len(placer.circles)] = placer.circles


def _middle_between(first: Floats, second: Floats) -> Floats:
    """The middle of the gap between two rooms, along the line from one middle to the other."""
    one, other = first.mean(axis=0), second.mean(axis=0)
    direction = (other - one) / np.hypot(*(other - one))
    from_first, to_second = float(((first - one) @ direction).max()), float(((second - one) @ direction).min())
    return np.asarray(one + direction * (from_first + to_second) / 2)


def _short_side(polygon: Floats) -> float:
    return float(np.hypot(*(np.roll(polygon, -1, axis=0) - polygon).T).min())


def _long_side(polygon: Floats) -> float:
    return float(np.hypot(*(np.roll(polygon, -1, axis=0) - polygon).T).max())


def _frame_post(half_m: float, rng: np.random.Generator) -> Item:
    return box(rng.uniform(0.08, 0.3), rng.uniform(0.08, max(0.1, half_m - 0.55)))


def _at_corridor_wall(half_m: float, rng: np.random.Generator) -> Item:
    deepest = max(0.1, half_m - 0.5)
    kind = rng.random()
    if kind < 0.3:
        return box(rng.uniform(0.2, 0.5), min(rng.uniform(0.08, 0.35), deepest))  # pilaster, pipe casing
    if kind < 0.5:
        return box(rng.uniform(0.6, 2.0), min(rng.uniform(0.08, 0.2), deepest))  # radiator, board
    if kind < 0.75:
        return box(rng.uniform(0.5, 1.8), min(rng.uniform(0.3, 0.6), deepest))  # cabinet, bench, copier
    return round_body(min(rng.uniform(0.06, 0.28), deepest / 2))  # extinguisher, bin, plant


def draw_floor_plan(seed: int, config: FloorPlanConfig | None = None) -> FloorPlan:
    """The building of a seed (0 or more): the same seed and config give the same arrays, to the byte."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed is {seed!r}; it must be a whole number of 0 or more")
    config = config if config is not None else FloorPlanConfig()
    rng = np.random.default_rng((int(seed), 0))
    name = config.layout
    if name == "any":
        drawn = str(rng.choice([other for other in LAYOUTS if other != "ladder"]))
        name = "ladder" if config.aliased else drawn
    builder = _Builder(int(seed), config, LAYOUTS[name](rng, config.scale), rng)
    builder.build()
    walls, glass = union_walls(builder.polygons, builder.glass_edges)
    panes = np.reshape(builder.panes, (-1, 4))
    inner = np.concatenate((*builder.segments, np.zeros((0, 4))))
    segments = np.concatenate((walls, panes, inner))
    is_glass = np.concatenate((glass, np.ones(len(panes), np.bool_), np.zeros(len(inner), np.bool_)))
    circles = np.concatenate((*builder.circles, np.zeros((0, 3))))
    return _turned(segments, is_glass, circles, builder, float(rng.uniform(-math.pi, math.pi)), name)


def _turned(
    segments: Floats, glass: npt.NDArray[np.bool_], circles: Floats, builder: _Builder, yaw: float, layout: str
) -> FloorPlan:
    """The building at a drawn angle, with its origin outside of it."""
    turn = np.array(((math.cos(yaw), -math.sin(yaw)), (math.sin(yaw), math.cos(yaw))))
    ends = segments.reshape(-1, 2) @ turn.T
    shift = _MARGIN_M - ends.min(axis=0)
    columns = list(zip(*builder.doors, strict=True)) if builder.doors else [()] * 8
    doors = Doors(
        np.reshape(columns[0], (-1, 2)) @ turn.T + shift,
        np.array(columns[1], dtype=np.float64) + yaw,
        np.array(columns[2], dtype=np.float64),
        np.array(columns[3], dtype=np.float64),
        np.reshape(columns[4], (-1, _DOOR_EPOCHS)),
        np.array(columns[5], dtype=np.float64),
        np.array(columns[6], dtype=np.float64),
        np.array(columns[7], dtype=np.bool_),
    )
    return FloorPlan(
        (ends + shift).reshape(-1, 4),
        glass,
        np.column_stack((circles[:, :2] @ turn.T + shift, circles[:, 2])),
        doors,
        np.array(builder.goals) @ turn.T + shift,
        layout,
    )
