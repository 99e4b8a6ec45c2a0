"""A 2D lidar among segments, circles and glass: exact ranges on a uniform grid, then the errors of a real scanner."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from ngo_common.settings import BadParameter, Settings, setting
from ngo_sim.convex_shapes import Floats

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

CELL_M = 0.7
# Within this angle of its normal a pane reflects the beam.
_GLASS_SHINES_COS = math.cos(math.radians(8.0))
NO_RETURNS = ("inf", "max", "zero")


@dataclass(frozen=True)
class ScannerConfig(Settings):
    """A scanner and its mounting on the robot."""

    rays: int = setting(360, "Rays of one scan.", minimum=1, maximum=10000)
    field_of_view_deg: float = setting(
        270.0,
        "Angle from the first ray to the last. At 360 the last ray ends one increment before the first.",
        minimum=1.0,
        maximum=360.0,
    )
    range_min_m: float = setting(0.05, "Shortest range that gives a return, m.", minimum=0.0, maximum=1.0)
    range_max_m: float = setting(30.0, "Longest range that gives a return, m.", minimum=1.0, maximum=200.0)
    scan_period_s: float = setting(0.1, "Time from one scan to the next, s.", minimum=0.005, maximum=1.0)
    sweep: float = setting(
        0.0, "Share of scan_period_s that one scan takes; 0: all rays at the same time.", minimum=0.0, maximum=1.0
    )
    clockwise: bool = setting(False, "Whether a scan runs from left to right, with a negative increment.")
    noise_m: float = setting(0.01, "Standard deviation of a range near the scanner, m.", minimum=0.0, maximum=1.0)
    noise_per_m: float = setting(
        0.001, "Increase of the standard deviation per metre of range.", minimum=0.0, maximum=0.1
    )
    dropout: float = setting(0.002, "Share of the rays that get no return at random.", minimum=0.0, maximum=1.0)
    glass_seen: float = setting(0.15, "Share of the rays on glass that the pane reflects.", minimum=0.0, maximum=1.0)
    glass_lost: float = setting(
        0.15, "Share of the rays on glass that get no return. The rest passes through.", minimum=0.0, maximum=1.0
    )
    resolution_m: float = setting(0.0, "Step to which ranges are rounded, m; 0: no rounding.", minimum=0.0, maximum=0.1)
    no_return: str = setting(
        "inf", "Range of a ray without a return. inf: infinity; max: range_max_m + 0.1 m; zero: 0.", choices=NO_RETURNS
    )
    increment_error: float = setting(
        0.0, "Relative error of the published angle increment.", minimum=-0.05, maximum=0.05
    )
    laser_x_m: float = setting(
        0.0, "Position of the scanner forward of the robot's centre, m.", minimum=-0.2, maximum=0.2
    )
    laser_y_m: float = setting(0.0, "Position of the scanner left of the robot's centre, m.", minimum=-0.1, maximum=0.1)
    laser_yaw_deg: float = setting(
        0.0, "Direction of the scanner, counter-clockwise from straight ahead, degrees.", minimum=-180.0, maximum=180.0
    )
    upside_down: bool = setting(False, "Whether the scanner is mounted upside down.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.glass_lost > 1.0 - self.glass_seen:
            raise BadParameter(
                f"parameter 'glass_lost' is {self.glass_lost!r}; allowed: a number from 0 to 1 - glass_seen"
            )

    @property
    def increment_rad(self) -> float:
        """Angle from one ray to the next in the scanner's frame, negative for a clockwise one."""
        view = math.radians(self.field_of_view_deg)
        step = view / self.rays if self.field_of_view_deg == 360.0 else view / max(1, self.rays - 1)
        return -step if self.clockwise else step

    @property
    def angles_rad(self) -> Floats:
        """(rays,) true angles in the scanner's own frame, symmetrical to straight ahead."""
        half = math.radians(self.field_of_view_deg) / 2
        first = half if self.clockwise else -half
        return first + self.increment_rad * np.arange(self.rays, dtype=np.float64)

    @property
    def time_increment_s(self) -> float:
        """Time from one ray to the next, 0 where all are cast at once."""
        return self.sweep * self.scan_period_s / self.rays

    @property
    def no_return_m(self) -> float:
        """The range that a ray without a return is given."""
        return {"inf": math.inf, "max": self.range_max_m + 0.1, "zero": 0.0}[self.no_return]

    def base_angles_rad(self) -> Floats:
        """(rays,) angles in the robot's frame, where an upside down scanner turns the other way."""
        sign = -1.0 if self.upside_down else 1.0
        return math.radians(self.laser_yaw_deg) + sign * self.angles_rad


def draw_scanner(rng: np.random.Generator) -> ScannerConfig:
    """A scanner such as robots have: 90 to 3000 rays over 90 to 360 deg, 4 to 100 m, 5 to 40 Hz."""
    rays = int(rng.choice((90, 180, 181, 270, 360, 361, 541, 720, 811, 1080, 1440, 3000)))
    view = float(rng.choice((90.0, 120.0, 180.0, 180.0, 240.0, 270.0, 270.0, 360.0, 360.0)))
    return ScannerConfig(
        rays=rays,
        field_of_view_deg=view,
        range_min_m=float(rng.uniform(0.0, 0.15)),
        range_max_m=float(rng.choice((4.0, 8.0, 12.0, 20.0, 30.0, 30.0, 50.0, 80.0, 100.0))),
        scan_period_s=1.0 / float(rng.choice((5.0, 6.0, 8.0, 10.0, 10.0, 15.0, 20.0, 40.0))),
        sweep=float(rng.choice((0.0, rng.uniform(0.5, 1.0)))),
        clockwise=bool(rng.random() < 0.15),
        noise_m=float(rng.choice((rng.uniform(0.003, 0.012), rng.uniform(0.012, 0.03)))),
        noise_per_m=float(rng.choice((0.0, rng.uniform(0.001, 0.01)))),
        dropout=float(rng.choice((0.0, rng.uniform(0.0, 0.02), rng.uniform(0.02, 0.1)))),
        glass_seen=float(rng.uniform(0.0, 0.4)),
        glass_lost=float(rng.uniform(0.0, 0.4)),
        resolution_m=float(rng.choice((0.0, 0.001, 0.01))),
        no_return=str(rng.choice(NO_RETURNS)),
        increment_error=float(rng.choice((0.0, 0.0, 0.0, rng.uniform(-0.006, 0.006)))),
        laser_x_m=float(rng.uniform(-0.1, 0.2)),
        laser_y_m=float(rng.choice((0.0, rng.uniform(-0.08, 0.08)))),
        laser_yaw_deg=float(rng.choice((0.0, rng.normal(0.0, 2.0), rng.choice((-90.0, 90.0, 180.0))))),
        upside_down=bool(rng.random() < 0.15),
    )


class RayWorld(NamedTuple):
    """Segments (n, 4) with glass (n,), circles (m, 3), and where door leaves may be, sorted into cells.

    Cell (row, col) holds items[starts[row * columns + col] : starts[row * columns + col + 1]]. Items below n are
    segments, below n + m circles, all others doors.
    """

    segments_m: Floats
    glass: Bools
    circles_m: Floats
    low_m: Floats
    columns: int
    rows: int
    starts: Ints
    items: Ints


class _Errors(NamedTuple):
    """The fields of a scanner that make ranges of distances, as compiled code takes them."""

    range_min_m: float
    range_max_m: float
    noise_m: float
    noise_per_m: float
    dropout: float
    resolution_m: float
    glass_seen: float
    glass_lost: float
    no_return_m: float


def ray_world(segments_m: Floats, glass: Bools, circles_m: Floats, door_circles_m: Floats) -> RayWorld:
    """Sort a world into cells; door_circles_m: (d, 3) discs that hold a door's leaf in each of its positions."""
    points = np.concatenate(
        (
            segments_m.reshape(-1, 2),
            circles_m[:, :2] - circles_m[:, 2:],
            circles_m[:, :2] + circles_m[:, 2:],
            door_circles_m[:, :2] - door_circles_m[:, 2:],
            door_circles_m[:, :2] + door_circles_m[:, 2:],
        )
    )
    if not len(points):
        raise ValueError("the world is empty; it must have at least one segment or circle")
    low = points.min(axis=0) - CELL_M
    columns, rows = (np.ceil((points.max(axis=0) + CELL_M - low) / CELL_M)).astype(int).tolist()
    segments, circles = np.ascontiguousarray(segments_m), np.ascontiguousarray(circles_m)
    discs = np.concatenate((circles_m, door_circles_m))
    starts, items = _fill_cells(segments, discs, low, columns, rows)
    return RayWorld(segments, np.ascontiguousarray(glass), circles, low, columns, rows, starts, items)


@njit(cache=True)
def _touches_cell(segment: Floats, x: float, y: float, half: float) -> bool:
    """Whether a segment may touch a square around x, y (separating axis across the segment)."""
    nx, ny = segment[3] - segment[1], segment[0] - segment[2]
    off = abs(nx * (x - segment[0]) + ny * (y - segment[1]))
    return bool(off <= half * (abs(nx) + abs(ny)) + 1e-9)


@njit(cache=True)
def _fill_cells(segments: Floats, discs: Floats, low: Floats, columns: int, rows: int) -> tuple[Ints, Ints]:
    half = CELL_M / 2 + 1e-6
    starts = np.zeros(rows * columns + 1, np.int64)
    items = np.zeros(0, np.int64)
    for sweep in range(2):  # count, then fill
        filled = starts[:-1].copy()
        for index in range(len(segments) + len(discs)):
            if index < len(segments):
                s = segments[index]
                x0, y0, x1, y1 = min(s[0], s[2]), min(s[1], s[3]), max(s[0], s[2]), max(s[1], s[3])
            else:
                c = discs[index - len(segments)]
                x0, y0, x1, y1 = c[0] - c[2], c[1] - c[2], c[0] + c[2], c[1] + c[2]
            for row in range(int((y0 - low[1] - 1e-6) // CELL_M), int((y1 - low[1] + 1e-6) // CELL_M) + 1):
                for col in range(int((x0 - low[0] - 1e-6) // CELL_M), int((x1 - low[0] + 1e-6) // CELL_M) + 1):
                    middle_x, middle_y = low[0] + (col + 0.5) * CELL_M, low[1] + (row + 0.5) * CELL_M
                    if index < len(segments) and not _touches_cell(segments[index], middle_x, middle_y, half):
                        continue
                    cell = row * columns + col
                    if sweep == 0:
                        starts[cell + 1] += 1
                    else:
                        items[filled[cell]] = index
                        filled[cell] += 1
        if sweep == 0:
            starts = np.cumsum(starts)
            items = np.empty(starts[-1], np.int64)
    return starts, items


@njit(cache=True)
def _to_segment(x: float, y: float, ux: float, uy: float, segment: Floats) -> tuple[float, float]:
    """Distance along the ray, infinite where it misses, and the cosine to the segment's normal."""
    dx, dy = segment[2] - segment[0], segment[3] - segment[1]
    cross = ux * dy - uy * dx
    if abs(cross) < 1e-12:
        return np.inf, 0.0
    off_x, off_y = segment[0] - x, segment[1] - y
    distance = (off_x * dy - off_y * dx) / cross
    share = (off_x * uy - off_y * ux) / cross
    if distance < 0.0 or share < 0.0 or share > 1.0:
        return np.inf, 0.0
    return distance, abs(cross) / np.hypot(dx, dy)


@njit(cache=True)
def _to_circle(x: float, y: float, ux: float, uy: float, circle: Floats) -> float:
    off_x, off_y = circle[0] - x, circle[1] - y
    along = off_x * ux + off_y * uy
    inside = circle[2] ** 2 - (off_x * uy - off_y * ux) ** 2
    if inside < 0.0:
        return np.inf
    near = along - np.sqrt(inside)
    return near if near >= 0.0 else np.inf


@njit(cache=True)
def _cast_ray(
    x: float,
    y: float,
    yaw: float,
    world: RayWorld,
    leaves: Floats,
    moving: Floats,
    errors: _Errors,
    rng: np.random.Generator,
) -> float:
    """Range of one ray from x, y along yaw, infinite where nothing is within reach.

    leaves: (d, 4) the doors now. moving: (p, 3) circles that are in no cell. Cells are visited in the order of the ray
    (Amanatides and Woo, 1987), and the visit ends with the first cell that holds a hit.
    """
    ux, uy = np.cos(yaw), np.sin(yaw)
    segments, circles, low, columns, rows = world.segments_m, world.circles_m, world.low_m, world.columns, world.rows
    best = reach = errors.range_max_m
    for index in range(len(moving)):
        best = min(best, _to_circle(x, y, ux, uy, moving[index]))
    # How this ray meets glass is drawn once, at the first pane: -1 is not drawn.
    chance = -1.0
    lost_at = np.inf
    # A ray from outside begins where it enters the cells; one that never does sees moving circles only.
    enter, leave = 0.0, np.inf
    for begin, along, size in ((x - low[0], ux, columns * CELL_M), (y - low[1], uy, rows * CELL_M)):
        if along == 0.0:
            if begin < 0.0 or begin >= size:
                leave = -1.0
        else:
            one, other = -begin / along, (size - begin) / along
            enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
    if enter >= leave:
        return best if best < reach else np.inf
    enter += 1e-9 if enter > 0.0 else 0.0
    cell_x, cell_y = (x + enter * ux - low[0]) / CELL_M, (y + enter * uy - low[1]) / CELL_M
    col, row = int(np.floor(cell_x)), int(np.floor(cell_y))
    step_col, step_row = (1 if ux > 0 else -1), (1 if uy > 0 else -1)
    per_col = CELL_M / abs(ux) if ux != 0.0 else np.inf
    per_row = CELL_M / abs(uy) if uy != 0.0 else np.inf
    next_col = enter + ((col + 1 - cell_x) if ux > 0 else (cell_x - col)) * per_col if ux != 0.0 else np.inf
    next_row = enter + ((row + 1 - cell_y) if uy > 0 else (cell_y - row)) * per_row if uy != 0.0 else np.inf
    while 0 <= col < columns and 0 <= row < rows:
        cell = row * columns + col
        for k in range(world.starts[cell], world.starts[cell + 1]):
            index = world.items[k]
            if index < len(segments):
                distance, cosine = _to_segment(x, y, ux, uy, segments[index])
                if distance >= best:
                    continue
                if world.glass[index] and cosine < _GLASS_SHINES_COS:
                    if chance < 0.0:
                        chance = rng.random()
                    if chance >= errors.glass_seen + errors.glass_lost:
                        continue
                    if chance >= errors.glass_seen:
                        lost_at = min(lost_at, distance)
                        continue
                best = distance
            elif index < len(segments) + len(circles):
                best = min(best, _to_circle(x, y, ux, uy, circles[index - len(segments)]))
            else:
                distance, _ = _to_segment(x, y, ux, uy, leaves[index - len(segments) - len(circles)])
                best = min(best, distance)
        if min(next_col, next_row) >= best:
            break
        if next_col < next_row:
            col += step_col
            next_col += per_col
        else:
            row += step_row
            next_row += per_row
    return best if best < min(reach, lost_at) else np.inf


@njit(cache=True)
def _cast(
    poses: Floats,
    twists: Floats,
    world: RayWorld,
    leaves: Floats,
    moving: Floats,
    angles: Floats,
    laser_xy: Floats,
    time_step: float,
    errors: _Errors,
    rng: np.random.Generator,
) -> npt.NDArray[np.float32]:
    scans, rays = len(poses), len(angles)
    ranges = np.empty((scans, rays), np.float32)
    for scan in range(scans):
        for ray in range(rays):
            x, y, yaw = poses[scan]
            if time_step > 0.0 or ray == 0:
                # Where the robot is at this ray: an arc of constant speed and turn rate.
                passed = time_step * ray
                turn, ahead = twists[scan, 1] * passed, twists[scan, 0] * passed
                if abs(turn) > 1e-9:
                    ahead *= np.sin(turn / 2) / (turn / 2)
                heading = yaw + turn
                cos, sin = np.cos(heading), np.sin(heading)
                eye_x = x + ahead * np.cos(yaw + turn / 2) + cos * laser_xy[0] - sin * laser_xy[1]
                eye_y = y + ahead * np.sin(yaw + turn / 2) + sin * laser_xy[0] + cos * laser_xy[1]
            distance = np.inf
            if errors.dropout == 0.0 or rng.random() >= errors.dropout:
                yaw = heading + angles[ray]
                distance = _cast_ray(eye_x, eye_y, yaw, world, leaves[scan], moving[scan], errors, rng)
            if distance < np.inf:
                deviation = errors.noise_m + errors.noise_per_m * distance
                if deviation > 0.0:
                    distance += deviation * rng.standard_normal()
                if errors.resolution_m > 0.0:
                    distance = errors.resolution_m * np.round(distance / errors.resolution_m)
            good = max(errors.range_min_m, 1e-6) <= distance <= errors.range_max_m
            ranges[scan, ray] = distance if good else errors.no_return_m
    return ranges


def cast_scans(
    world: RayWorld,
    scanner: ScannerConfig,
    poses_xyyaw: Floats,
    twists: Floats,
    leaves_m: Floats,
    moving_m: Floats,
    rng: np.random.Generator,
) -> npt.NDArray[np.float32]:
    """float32 (scans, rays) ranges in m of the robot at poses (scans, 3), each the pose at the scan's first ray.

    twists: (scans, 2) speed m/s and turn rate rad/s during a scan. leaves_m: (scans, d, 4) door leaves. moving_m:
    (scans, p, 3) moving circles; all stand still during a scan. rng: of noise, dropouts and glass; scans one by one
    draw the same as all at once.
    """
    errors = _Errors(*(float(getattr(scanner, name)) for name in _Errors._fields))
    poses, moved, doors, people = map(np.ascontiguousarray, (poses_xyyaw, twists, leaves_m, moving_m))
    laser_xy, angles = np.array((scanner.laser_x_m, scanner.laser_y_m)), scanner.base_angles_rad()
    step_s = float(scanner.time_increment_s)
    return np.asarray(_cast(poses, moved, world, doors, people, angles, laser_xy, step_s, errors, rng))
