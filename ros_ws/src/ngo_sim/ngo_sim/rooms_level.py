"""Levels of rooms: convex rooms of all sizes and angles with what joins and fills them, as UDMF text.

A rectangle is split by lines of any angle until its parts are rooms. Each part is shrunk by the thickness of its walls,
and some of its corners are cut. What joins two rooms crosses the wall between them: a passage, stairs, a door, a window
or a ledge. Pillars, platforms, pits and pools stand inside rooms. Everything follows from the generator given.
"""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import networkx as nx
import numpy as np

from ngo_sim.doom_engine import MAZE_GAME
from ngo_sim.doom_map import DECORATIONS, UNITS_PER_M, thing
from ngo_sim.doom_wad import read_wad

T = TypeVar("T")
Point = tuple[float, float]
Edge = tuple[Point, int]
"""The corner at which an edge of a convex polygon begins (counter-clockwise), and the line that it lies on."""

STEP_UNITS = 24  # The highest step that the player climbs.

_SIZE_M = (24.0, 70.0)
_ROOM_M2 = (20.0, 500.0)
_NARROWEST_M = 1.5
_BODY_M = 1.5  # the player is a square of 1 m along the map's axes
_STAIR_M = 0.4
_NO_LINE, _BORDER = -2, -1
_SKY, _POOLS = "F_SKY1", ("FWATER1", "NUKAGE1", "BLOOD1", "SLIME01", "LAVA1")
_LIGHTS = (65, 66, 67, 72, 81)  # flicker, two strobes, glow and fire of ZDoom's sector types
_STANDING_THINGS = (30, 31, 32, 33, 35, 41, 43, 44, 45, 46, 47, 48, 54, 55, 56, 57, 2028, 2035)
_DOOR = "special=12;arg1=16;arg2=150;playeruse=true;repeatspecial=true;"


@dataclass
class _Room:
    edges: list[Edge]
    floor: int = 0
    ceiling: int = 0
    sector: int = 0
    wall: str = ""
    openings: dict[int, list[tuple[Point, Point, int, str]]] = field(default_factory=dict)
    """For each edge the parts that are open, in its direction: ends, the sector behind and what the line does."""

    @property
    def middle(self) -> Point:
        """The mean of its corners, m."""
        x, y = np.mean([corner for corner, _ in self.edges], axis=0).tolist()
        return x, y


@functools.cache
def _names() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """All wall textures that are higher than a trim, and all flats, of the mazes' game."""
    walls, flats, inside = [], [], False
    for name, data in read_wad(MAZE_GAME).lumps:
        if name in ("TEXTURE1", "TEXTURE2"):
            (count,) = struct.unpack_from("<i", data)
            for offset in struct.unpack_from(f"<{count}i", data, 4):
                label, _, _, height = struct.unpack_from("<8sihh", data, offset)
                texture = label.rstrip(b"\0").decode("ascii")
                if height >= 64 and not texture.startswith(("AA", "SKY", "RSKY", "MID", "SW")):
                    walls.append(texture)
        inside = (inside or name == "F_START") and name != "F_END"
        if inside and len(data) == 64 * 64 and name != _SKY:
            flats.append(name)
    return tuple(walls), tuple(flats)


def rooms_textmap(rng: np.random.Generator, start_rng: np.random.Generator) -> str:
    """The UDMF text of a level of rooms drawn by ``rng``, with the player's start drawn by ``start_rng``."""
    return _Level(rng).text(start_rng)


class _Level:
    """One level while it is made."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.lines: list[tuple[Point, Point]] = []  # a point and the unit direction
        self.parts: dict[str, list[str]] = {name: [] for name in ("thing", "sector", "vertex", "sidedef", "linedef")}
        self.vertices: dict[Point, int] = {}
        walls, flats = _names()
        # A level has a few textures, so that its places look alike.
        self.walls = [walls[i] for i in rng.integers(len(walls), size=rng.integers(3, 14))]
        self.flats = [flats[i] for i in rng.integers(len(flats), size=rng.integers(3, 10))]

    def text(self, start_rng: np.random.Generator) -> str:
        width, height = self.rng.uniform(*_SIZE_M, size=2).tolist()
        turn = self.rng.uniform(0, math.pi) if self.chance(0.3) else 0.0
        corners = ((0.0, 0.0), (width, 0.0), (width, height), (0.0, height))
        cells = self.split([(_turned(corner, turn), _BORDER) for corner in corners])
        half_walls = [self.drawn((0.125, 0.25, 0.5, self.rng.uniform(0.2, 1.5))) for _ in self.lines]
        rooms = [room for room in (self.room(cell, half_walls) for cell in cells) if room is not None]
        self.join(rooms, half_walls)
        # What was left without a door is no room.
        rooms = [room for room in rooms if room.openings]
        for room in rooms:
            self.surround(room)
            self.fill(room)
        areas = np.array([_area(room.edges) for room in rooms])
        x, y = rooms[int(start_rng.choice(len(rooms), p=areas / areas.sum()))].middle
        self.parts["thing"].append(thing(1, x * UNITS_PER_M, y * UNITS_PER_M, int(start_rng.integers(360))))
        return 'namespace="zdoom";\n' + "".join("".join(parts) for parts in self.parts.values())

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def drawn(self, options: Sequence[T]) -> T:
        return options[int(self.rng.integers(len(options)))]

    # Rooms

    def split(self, cell: list[Edge]) -> list[list[Edge]]:
        """The cells that lines of drawn angles make of one."""
        area, smallest = _area(cell), math.exp(self.rng.uniform(*np.log(_ROOM_M2)))
        for _ in range(10 if area > smallest else 0):
            (x0, y0), (x1, y1) = max(_sides(cell), key=lambda side: math.dist(*side))
            along = math.atan2(y1 - y0, x1 - x0) + (0.0 if self.chance(0.75) else self.rng.uniform(-0.6, 0.6))
            angle = along + (math.pi / 2 if self.chance(0.85) else 0.0)
            share = self.rng.dirichlet(np.full(len(cell), 2.0))
            x, y = (float(value) for value in share @ np.array([corner for corner, _ in cell]))
            line = (x, y), (math.cos(angle), math.sin(angle))
            halves = [_clipped(cell, *_shifted(line, 0.0, side), len(self.lines)) for side in (1, -1)]
            if all(len(half) >= 3 and _width(half) > _NARROWEST_M + 1.2 for half in halves):
                self.lines.append(line)
                return [part for half in halves for part in self.split(half)]
        return [cell]

    def room(self, cell: list[Edge], half_walls: list[float]) -> _Room | None:
        """The room inside of a cell; None where its walls leave none."""
        edges = cell
        for (start, end), (_, line) in zip(_sides(cell), cell, strict=True):
            inward = 0.5 if line == _BORDER else half_walls[line]
            direction = _direction(start, end)
            edges = _clipped(edges, *_shifted((start, direction), inward, 1), line)
        if len(edges) < 3 or _width(edges) < _NARROWEST_M:
            return None
        if self.chance(0.4):
            for corner, _ in list(edges):
                if self.chance(0.7):
                    edges = self.without_corner(edges, corner)
        room = _Room(edges, wall=self.drawn(self.walls))
        room.ceiling = int(self.drawn((112, 128, 144, 192, 256, 384)))
        return room

    def without_corner(self, edges: list[Edge], corner: Point) -> list[Edge]:
        """The polygon with this corner cut off, where it stays wide enough."""
        at = [point for point, _ in edges].index(corner)
        before, after = edges[at - 1][0], edges[(at + 1) % len(edges)][0]
        most = min(math.dist(before, corner), math.dist(corner, after))
        cut = self.rng.uniform(0.15, 0.35) * most
        first, last = _toward(corner, before, cut), _toward(corner, after, cut)
        shorter = _clipped(edges, first, _direction(first, last), _NO_LINE)
        return shorter if len(shorter) >= 3 and _width(shorter) >= _NARROWEST_M else edges

    # What joins rooms

    def join(self, rooms: list[_Room], half_walls: list[float]) -> None:
        """Draw the floors of rooms and join each with its neighbours, by a tree of ways and by more than that."""
        on_line: dict[int, list[tuple[int, int]]] = {}
        for index, room in enumerate(rooms):
            for edge, (_, line) in enumerate(room.edges):
                if line >= 0:
                    on_line.setdefault(line, []).append((index, edge))
        graph = nx.Graph()
        for line, members in on_line.items():
            (x, y), (ux, uy) = self.lines[line]
            spans = []
            for index, edge in members:
                ends = [(px - x) * ux + (py - y) * uy for px, py in _sides(rooms[index].edges)[edge]]
                side = ends[1] > ends[0]
                spans.append((index, edge, side, min(ends), max(ends)))
            for a, edge_a, _, low_a, high_a in (span for span in spans if span[2]):
                for b, edge_b, _, low_b, high_b in (span for span in spans if not span[2]):
                    low, high = max(low_a, low_b) + 0.1, min(high_a, high_b) - 0.1
                    if high - low > _BODY_M and not graph.has_edge(a, b):
                        graph.add_edge(a, b, line=line, thickness=2 * half_walls[line],
                                       edges={a: edge_a, b: edge_b}, low=low, high=high,
                                       weight=self.rng.random())  # fmt: skip
        if not graph:
            return
        largest = max(nx.connected_components(graph), key=len)
        tree = nx.minimum_spanning_tree(graph.subgraph(sorted(largest)))
        for a, b in nx.bfs_edges(tree, min(largest)):
            rise = int(self.drawn((0, 0, 0, 8, 16, 24, 48, 96)))
            if self.strips(rise) * _STAIR_M > tree.edges[a, b]["thickness"]:
                rise = min(rise, 48)
            rooms[b].floor = rooms[a].floor + int(self.drawn((-1, 1))) * rise
        for index in sorted(largest):
            rooms[index].ceiling += rooms[index].floor
            rooms[index].sector = self.room_sector(rooms[index])
        for a, b in sorted(graph.subgraph(largest).edges):
            if tree.has_edge(a, b) or self.chance(0.5):
                self.link(rooms, a, b, graph.edges[a, b], tree.has_edge(a, b))

    def link(self, rooms: list[_Room], a: int, b: int, between: dict[str, Any], needed: bool) -> None:
        """Open the wall between two rooms: by strips of floor from one to the other, each a sector of its own."""
        length = between["high"] - between["low"]
        width = self.rng.uniform(_BODY_M, min(length, self.drawn((2.0, 3.0, 5.0, 20.0))))
        low = between["low"] + self.rng.uniform(0.0, length - min(width, length))
        origin, direction = self.lines[between["line"]]
        ends = []  # of the opening on either room's edge
        for room in (a, b):
            start, _ = _sides(rooms[room].edges)[between["edges"][room]]
            away = _cross(direction, (start[0] - origin[0], start[1] - origin[1]))
            normal = -direction[1] * away, direction[0] * away
            ends.append([(origin[0] + at * direction[0] + normal[0], origin[1] + at * direction[1] + normal[1])
                         for at in (low, low + min(width, length))])  # fmt: skip
        floor_a, floor_b = rooms[a].floor, rooms[b].floor
        rise = abs(floor_b - floor_a)
        kind = "passage" if needed else str(self.drawn(("passage", "window", "ledge")))
        if kind == "passage" and rise == 0 and self.chance(0.3):
            kind = "door"
        strips = self.strips(rise)
        if kind != "passage" or strips * _STAIR_M > between["thickness"]:
            strips = 1
        top = max(floor_a, floor_b)
        if kind == "window":
            floors, ceiling = [top + int(self.drawn((28, 36)))], top + int(self.drawn((72, 104)))
        elif kind == "door":
            floors, ceiling = [top], top
        else:
            floors = [round(floor_a + (floor_b - floor_a) * (i + 1) / (strips + 1)) for i in range(strips)]
            ceiling = top + int(self.drawn((72, 96, 128)))
        wall, flat = self.drawn(self.walls), self.drawn(self.flats)
        ceiling_flat, light = self.drawn(self.flats), int(self.rng.integers(112, 240))
        sectors = [self.sector(floor, ceiling, flat, ceiling_flat, light) for floor in floors]
        does = _DOOR if kind == "door" else ""
        cuts = [[_between(ends[0][k], ends[1][k], i / strips) for k in (0, 1)] for i in range(strips + 1)]
        for i, sector in enumerate(sectors):
            # Room a lies to the left of the line, so the strips go from it to the right.
            (near_0, near_1), (far_0, far_1) = cuts[i], cuts[i + 1]
            self.line(near_0, far_0, sector, wall) if self.left_of(near_0, far_0, near_1) else self.line(
                far_0, near_0, sector, wall
            )
            self.line(far_1, near_1, sector, wall) if self.left_of(far_1, near_1, near_0) else self.line(
                near_1, far_1, sector, wall
            )
            if i:
                first, last = (near_0, near_1) if self.left_of(near_0, near_1, far_0) else (near_1, near_0)
                self.line(first, last, sector, wall, sectors[i - 1])
        for room, opening, sector in ((a, ends[0], sectors[0]), (b, ends[1], sectors[-1])):
            edge = between["edges"][room]
            start = rooms[room].edges[edge][0]
            first, last = sorted(opening, key=lambda point: math.dist(point, start))
            rooms[room].openings.setdefault(edge, []).append((first, last, sector, does))

    @staticmethod
    def strips(rise: int) -> int:
        """Strips of floor between two floors of this difference, by which the player climbs."""
        return max(1, math.ceil(rise / STEP_UNITS) - 1)

    @staticmethod
    def left_of(start: Point, end: Point, point: Point) -> bool:
        return _cross((end[0] - start[0], end[1] - start[1]), (point[0] - start[0], point[1] - start[1])) > 0

    # Lines, and what fills rooms

    def surround(self, room: _Room) -> None:
        """The lines of a room's border."""
        for edge, (start, end) in enumerate(_sides(room.edges)):
            wall = room.wall if self.chance(0.8) else self.drawn(self.walls)
            at = start
            for first, last, sector, does in sorted(
                room.openings.get(edge, []), key=lambda opening: math.dist(opening[0], start)
            ):
                self.line(at, first, room.sector, wall)
                self.line(first, last, room.sector, wall, sector, does)
                at = last
            self.line(at, end, room.sector, wall)

    def fill(self, room: _Room) -> None:
        """Pillars, platforms, pits, pools and things; the middle, where the player may start, stays free."""
        taken = [(room.middle, 0.3)]
        area = _area(room.edges)
        for _ in range(int(self.rng.poisson(min(4.0, area / 25.0)))):
            radius = float(np.exp(self.rng.uniform(math.log(0.2), math.log(4.0))))
            center = self.free_place(room, taken, radius, 0.65)
            if center is None:
                continue
            count, turn = int(self.rng.integers(3, 9)), self.rng.uniform(0, math.tau)
            angles = [turn + math.tau * k / count for k in range(count)]
            corners = [(center[0] + radius * math.cos(a), center[1] + radius * math.sin(a)) for a in angles]
            wall, sector = self.drawn(self.walls), None
            if radius > 0.7 and self.chance(0.75):
                sector = self.inner_sector(room)
            for first, last in zip(corners, corners[1:] + corners[:1], strict=True):
                self.line(last, first, room.sector, wall, sector)
        for _ in range(int(self.rng.poisson(min(5.0, area / 20.0)))):
            kinds = _STANDING_THINGS if self.chance(0.5) else DECORATIONS
            center = self.free_place(room, taken, 0.4, 0.4)
            if center is not None:
                x, y = center
                kind = int(self.drawn(kinds))
                self.parts["thing"].append(thing(kind, x * UNITS_PER_M, y * UNITS_PER_M, 0))

    def free_place(self, room: _Room, taken: list[tuple[Point, float]], radius: float, gap: float) -> Point | None:
        """A drawn middle of a circle in a room that keeps a gap to its walls and to what is taken, or None."""
        for _ in range(6):
            share = self.rng.dirichlet(np.ones(len(room.edges)))
            x, y = (float(value) for value in share @ np.array([corner for corner, _ in room.edges]))
            clear = min(
                _cross(_direction(start, end), (x - start[0], y - start[1])) for start, end in _sides(room.edges)
            )
            if clear > radius + gap and all(math.dist((x, y), at) > radius + r + gap for at, r in taken):
                taken.append(((x, y), radius))
                return x, y
        return None

    def room_sector(self, room: _Room) -> int:
        sky = self.chance(0.15)
        light = int(self.rng.integers(120, 256))
        special = int(self.drawn(_LIGHTS)) if self.chance(0.2) else 0
        return self.sector(
            room.floor, room.ceiling, self.drawn(self.flats), _SKY if sky else self.drawn(self.flats), light, special
        )

    def inner_sector(self, room: _Room) -> int:
        """A platform, a pit, a pool, or only another ceiling and light."""
        rise = int(self.drawn((0, 8, 16, 24, 48, -8, -16, -24)))
        pool = rise < 0 and self.chance(0.5)
        top = room.ceiling + int(self.drawn((0, 0, 32, 64, -16)))
        flat = self.drawn(_POOLS) if pool else self.drawn(self.flats)
        return self.sector(
            room.floor + rise, top, flat, self.drawn((*self.flats, _SKY)), int(self.rng.integers(120, 256))
        )

    # UDMF

    def sector(self, floor: int, ceiling: int, floor_flat: str, ceiling_flat: str, light: int, special: int = 0) -> int:
        of_flats = ""
        if self.chance(0.4):
            scale, turn = self.rng.uniform(0.5, 2.0), int(self.rng.integers(360))
            of_flats = f"xscalefloor={scale:.3f};yscalefloor={scale:.3f};rotationfloor={turn}.0;"
        self.parts["sector"].append(
            f'sector{{heightfloor={floor};heightceiling={ceiling};texturefloor="{floor_flat}";'
            f'textureceiling="{ceiling_flat}";lightlevel={light};special={special};{of_flats}}}\n'
        )
        return len(self.parts["sector"]) - 1

    def line(self, start: Point, end: Point, sector: int, wall: str, behind: int | None = None, does: str = "") -> None:
        """A line with ``sector`` on its left: a wall, or open to the sector ``behind``."""
        if math.dist(start, end) < 1e-3:
            return
        sides = [self.side(sector, wall, behind is not None)]
        opening = "blocking=true;"
        if behind is not None:
            sides.append(self.side(behind, wall, True))
            opening = f"twosided=true;sideback={sides[1]};{does}"
        # The engine's front side is the right one.
        self.parts["linedef"].append(
            f"linedef{{v1={self.vertex(end)};v2={self.vertex(start)};sidefront={sides[0]};{opening}}}\n"
        )

    def side(self, sector: int, wall: str, is_open: bool) -> int:
        offset = self.rng.integers(128, size=2)
        scale = self.rng.uniform(0.5, 2.0) if self.chance(0.3) else 1.0
        names, parts = (("top", "bottom"), ("top", "bottom")) if is_open else (("middle",), ("mid",))
        looks = "".join(f'texture{name}="{wall}";' for name in names)
        looks += "".join(f"scalex_{part}={scale:.3f};scaley_{part}={scale:.3f};" for part in parts)
        self.parts["sidedef"].append(f"sidedef{{sector={sector};offsetx={offset[0]};offsety={offset[1]};{looks}}}\n")
        return len(self.parts["sidedef"]) - 1

    def vertex(self, point: Point) -> int:
        key = round(point[0] * UNITS_PER_M, 2), round(point[1] * UNITS_PER_M, 2)
        if key not in self.vertices:
            self.vertices[key] = len(self.vertices)
            self.parts["vertex"].append(f"vertex{{x={key[0]:.2f};y={key[1]:.2f};}}\n")
        return self.vertices[key]


def _sides(edges: list[Edge]) -> list[tuple[Point, Point]]:
    corners = [corner for corner, _ in edges]
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


def _cross(a: Point, b: Point) -> float:
    return a[0] * b[1] - a[1] * b[0]


def _direction(start: Point, end: Point) -> Point:
    length = math.dist(start, end)
    return (end[0] - start[0]) / length, (end[1] - start[1]) / length


def _between(a: Point, b: Point, share: float) -> Point:
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])


def _toward(start: Point, end: Point, distance: float) -> Point:
    return _between(start, end, distance / math.dist(start, end))


def _turned(point: Point, angle: float) -> Point:
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]


def _shifted(line: tuple[Point, Point], left: float, side: int) -> tuple[Point, Point]:
    """The line moved to its left; with side -1 in the other direction."""
    (x, y), (ux, uy) = line
    return (x - left * uy, y + left * ux), (side * ux, side * uy)


def _area(edges: list[Edge]) -> float:
    return 0.5 * sum(_cross(start, end) for start, end in _sides(edges))


def _width(edges: list[Edge]) -> float:
    """The smallest extent of a convex polygon across any of its edges."""
    return min(
        max(_cross(_direction(start, end), (x - start[0], y - start[1])) for (x, y), _ in edges)
        for start, end in _sides(edges)
    )


def _clipped(edges: list[Edge], origin: Point, direction: Point, line: int) -> list[Edge]:
    """The part of a convex polygon to the left of a line; the new edge is said to lie on ``line``."""
    kept: list[Edge] = []
    heights = [_cross(direction, (x - origin[0], y - origin[1])) for (x, y), _ in edges]
    for index, ((start, end), (_, own)) in enumerate(zip(_sides(edges), edges, strict=True)):
        here, there = heights[index], heights[(index + 1) % len(edges)]
        if here >= 0:
            kept.append((start, own))
        if (here >= 0) != (there >= 0):
            crossing = _between(start, end, here / (here - there))
            kept.append((crossing, line if here >= 0 else own))
    # Corners that fall together would make edges without a direction.
    return [edge for index, edge in enumerate(kept) if math.dist(edge[0], kept[index - 1][0]) > 1e-6]
