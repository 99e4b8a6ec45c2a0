"""A robot that explores a simulated world in this process: its map, its path, and what it saw of what can be seen."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Protocol

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.mapping.occupancy_grid import UNKNOWN, OccupancyConfig, OccupancyGrid, OccupancyMap
from ngo_estimator.mapping.range_scan import RangeScan
from ngo_estimator.mapping.scan_map import ScanMap
from ngo_explorer.exploration import Exploration
from ngo_explorer.known_map import KnownMap
from ngo_explorer.path_follower import DRIVING, PathFollower
from ngo_explorer.pilot import DONE, Pilot
from ngo_explorer.settings import DriveConfig, ExplorerConfig
from training.data.explored_worlds import ExploredWorld, Sight
from training.data.lidar_drives import TruePoses
from training.scoring.known_tour import known_tour

RESOLUTION_M = 0.05
ENOUGH = 0.95  # of what can be seen: up to there paths are compared
_MAP_EVERY_S = 0.5
_MOVED_M, _TURNED_RAD = 0.1, math.radians(5.0)  # between two scans that enter the map
_OCCUPANCY = OccupancyConfig()


@dataclass(frozen=True, eq=False)
class Explored:
    """One exploration of n maps.

    ``path_m``, ``coverage`` and ``time_s`` ``(n,)``: length of the path, share seen of what can be seen, and time.
    ``poses_xyyaw`` ``(m, 3)`` true. ``ended`` says whether the robot ended it by itself. ``found`` is its own map,
    aligned with the truth as a whole, ``at_true_poses`` that of the same scans at true poses. ``in_reach`` is the share
    seen at the end of what can be seen from where a way led then: a door may have shut. ``errors`` are those of its own
    poses, by the metric's key: ``ate_m`` when ``ENOUGH`` had been seen, ``ate_end_m`` at the end.
    """

    path_m: np.ndarray
    coverage: np.ndarray
    time_s: np.ndarray
    poses_xyyaw: np.ndarray
    decisions_ms: np.ndarray
    collisions: int
    ended: bool
    found: OccupancyMap
    at_true_poses: OccupancyMap
    in_reach: float
    errors: dict[str, float] = field(default_factory=dict)

    def path_to(self, coverage: float) -> float:
        """Path until so much was seen, m; infinite where it never was."""
        reached = np.flatnonzero(self.coverage >= coverage)
        return float(self.path_m[reached[0]]) if len(reached) else math.inf


class Estimator(Protocol):
    """Who tells a robot its pose ``(3,)``, of which time that is, and its map, in the frame of the world."""

    pose_xyyaw: np.ndarray
    stamp_ns: int

    def take(self, sight: Sight) -> None:
        """Take what was measured."""
        ...

    def cells(self) -> OccupancyMap:
        """The map so far."""
        ...

    def aligned_cells(self, truth: TruePoses) -> OccupancyMap:
        """The map, aligned with the truth as a whole."""
        ...

    def errors(self, truth: TruePoses) -> dict[str, float]:
        """How wrong the poses are, by the metric's key."""
        ...


class TruePosesMap:
    """Knows the true poses, and maps as a robot that estimates them does."""

    stamp_ns = 0

    def __init__(self, first_xyyaw: np.ndarray) -> None:
        self.pose_xyyaw, self._map = first_xyyaw, ScanMap()
        self._stamps_ns, self._poses = np.zeros(0, np.int64), np.zeros((0, 3))  # of the scans that the map takes

    def take(self, sight: Sight) -> None:
        """Take what was seen, and where."""
        stamp_ns, waiting, nothing = round(1e9 * sight.time_s), self._map.waiting, np.zeros(0, np.float32)
        first_ns = int(np.append(self._stamps_ns, stamp_ns)[0])
        self.pose_xyyaw = sight.pose_xyyaw
        pose = np.zeros(3), np.eye(3), first_ns, sight.pose_xyyaw
        self._map.take(RelativeStep(stamp_ns, stamp_ns, *pose, nothing, nothing), [(stamp_ns, sight.scan)])
        if self._map.waiting > waiting:
            self._stamps_ns = np.append(self._stamps_ns, stamp_ns)
            self._poses = np.vstack((self._poses, sight.pose_xyyaw))

    def cells(self) -> OccupancyMap:
        """The map so far."""
        self._map.update(self._stamps_ns, self._poses)
        return self._map.cells()

    def aligned_cells(self, truth: TruePoses) -> OccupancyMap:
        """The same: it is where the truth is."""
        return self.cells()

    def errors(self, truth: TruePoses) -> dict[str, float]:
        """None."""
        return {}


class Seen:
    """What can be seen of a world, by exact scans from ``poses`` ``(n, 3)``, and how much of it a map holds."""

    def __init__(self, scans: list[RangeScan], poses: np.ndarray) -> None:
        self.scans, self.poses = scans, poses
        grid = OccupancyGrid(RESOLUTION_M)
        for begin in range(0, len(scans), 200):
            grid.add(scans[begin : begin + 200], poses[begin : begin + 200])
        self.map = _trinary(grid.cells(_OCCUPANCY))
        self._free = self.map.values == 0
        self._cells = int(np.count_nonzero(self._free))

    def in_reach(self, world: ExploredWorld) -> Seen:
        """What can be seen of it from where a way leads to from where the robot is, as doors stand now."""
        near = world.in_reach(self.poses)
        return self if near.all() else Seen(list(compress(self.scans, near)), self.poses[near])

    def free_points(self) -> np.ndarray:
        """Middles ``(n, 2)`` of the free cells that can be seen."""
        return self.map.origin_xy + (np.argwhere(self._free)[:, ::-1] + 0.5) * RESOLUTION_M

    def coverage(self, found: OccupancyMap) -> float:
        """Share of the free cells that can be seen which a map knows; 1 where there are none."""
        return self.share(self.count(found))

    def share(self, count: int) -> float:
        """So many of the free cells that can be seen, as a share; 1 where there are none."""
        return count / self._cells if self._cells else 1.0

    def count(self, found: OccupancyMap) -> int:
        """How many of the free cells that can be seen a map, or a part of one, knows."""
        known = _trinary(found).values != UNKNOWN
        column, row = np.rint((found.origin_xy - self.map.origin_xy) / RESOLUTION_M).astype(int).tolist()
        rows, columns = self._free.shape
        top, left = max(0, row), max(0, column)
        low, right = min(rows, row + found.values.shape[0]), min(columns, column + found.values.shape[1])
        if top >= low or left >= right:
            return 0
        known = known[top - row : low - row, left - column : right - column]
        return int(np.count_nonzero(known & self._free[top:low, left:right]))


def explore(
    world: ExploredWorld,
    seen: Seen,
    config: ExplorerConfig,
    drive: DriveConfig,
    seed: int = 0,
    most_s: float = 3600.0,
    estimator: Callable[[np.ndarray], Estimator] = TruePosesMap,
) -> Explored:
    """Explore a world until the robot says that nothing is left, or for most_s of simulated time.

    estimator: begins one at the first pose. What the robot has seen is counted at true poses always.
    """
    run = _Run(world, seen, estimator)
    exploration = Exploration(config, seed=seed)
    run.drive(exploration, PathFollower(drive, config), most_s)
    return run.explored()


def drive_known_tour(
    world: ExploredWorld, seen: Seen, config: ExplorerConfig, drive: DriveConfig, most_s: float = 3600.0
) -> Explored:
    """Drive the tour of a robot that knows the map, and then explore what it has left out."""
    run = _Run(world, seen)
    known = KnownMap(config.radius_m, config.comfort_m)
    known.update(seen.map.values, RESOLUTION_M, seen.map.origin_xy)
    follower = PathFollower(drive, config)
    for path in known_tour(seen.scans, seen.poses, known, run.sight.pose_xyyaw[:2], config.need_m(RESOLUTION_M)):
        follower.follow(path, float(np.arctan2(*(path[-1] - path[max(0, len(path) - 5)])[::-1])))
        while follower.state == DRIVING and run.sight.time_s < most_s:
            run.look()
            run.show(follower)
            run.move(*follower.step(known, run.sight.pose_xyyaw, run.sight.time_s))
    run.drive(Exploration(replace(config, rule="nearest")), follower, most_s)
    return run.explored()


class _Run:
    """A robot on its way, its map and what is written down of both."""

    def __init__(
        self, world: ExploredWorld, seen: Seen, estimator: Callable[[np.ndarray], Estimator] = TruePosesMap
    ) -> None:
        self._world, self._seen, self._grid = world, seen, OccupancyGrid(RESOLUTION_M)
        self.sight = world.step(0.0, 0.0)
        self._estimator = estimator(self.sight.pose_xyyaw)
        self._stamps_ns = list[int]()
        self._hear()
        self._rows: list[tuple[float, float, float]] = []
        self._poses, self._decisions_ms = [self.sight.pose_xyyaw], list[float]()
        self._entered: np.ndarray | None = None
        self._mapped_s, self._path_m, self._collisions, self._touched, self._ended = -math.inf, 0.0, 0, False, False
        self._enough: dict[str, float] | None = None
        self.found = self._estimator.cells()
        self._true, self._count = self._grid.cells(_OCCUPANCY), 0  # what was seen at true poses, and what counts of it

    @property
    def pose_xyyaw(self) -> np.ndarray:
        """Where the robot believes to be."""
        return self._estimator.pose_xyyaw

    @property
    def late_s(self) -> float:
        """How old that pose is."""
        known_ns = self._estimator.stamp_ns
        return 1e-9 * (self.sight.stamp_ns - known_ns) if known_ns else 0.0

    def show(self, follower: PathFollower) -> None:
        """Let the follower have the newest scan."""
        scan = self.sight.scan
        follower.look(scan.ends[scan.hits].astype(np.float64), self.sight.time_s)

    def drive(self, exploration: Exploration, follower: PathFollower, most_s: float) -> None:
        """Explore until nothing is left. Decisions on new maps are timed by the time of this process, on one core."""
        pilot = Pilot(exploration, follower, 2.0 * _MAP_EVERY_S, None)
        follower.stop()
        while self.sight.time_s < most_s and pilot.state != DONE:
            mapped, decided = self.look(), pilot.decided
            begun_s = time.process_time() if mapped else 0.0  # asking costs as much as a step
            if mapped or exploration.known.empty:
                found = self.found
                exploration.known.update(found.values, RESOLUTION_M, found.origin_xy, found.changed)
            pilot.step(self.pose_xyyaw, self.sight.time_s)
            if mapped and pilot.decided > decided:
                self._decisions_ms.append(1e3 * (time.process_time() - begun_s))
            self.show(follower)
            self.move(*follower.step(exploration.known, self.pose_xyyaw, self.sight.time_s, self.late_s))
        self._ended = pilot.state == DONE

    def look(self) -> bool:
        """Enter what is seen, and draw the map from time to time; returns whether it was drawn."""
        sight = self.sight
        if self._entered is None or _moved(self._entered, sight.pose_xyyaw):
            self._entered = sight.pose_xyyaw
            self._grid.add([sight.scan], sight.pose_xyyaw[None])
        if sight.time_s - self._mapped_s < _MAP_EVERY_S - 1e-6:
            return False
        self._mapped_s = sight.time_s
        self.found = self._estimator.cells()
        before, self._true = self._true, self._grid.cells(_OCCUPANCY)
        if (part := self._true.changed) is None:
            self._count = self._seen.count(self._true)
        else:
            self._count += self._seen.count(self._true.part(*part)) - self._seen.count(before.part(*part))
        self._rows.append((self._path_m, self._seen.share(self._count), sight.time_s))
        if self._enough is None and self._rows[-1][1] >= ENOUGH:
            self._enough = self._estimator.errors(self._truth())
        return True

    def _truth(self) -> TruePoses:
        return TruePoses(np.array(self._stamps_ns), np.array(self._poses))

    def _hear(self) -> None:
        self._estimator.take(self.sight)
        self._stamps_ns.append(self.sight.stamp_ns)

    def move(self, speed_mps: float, turn_rate_rps: float) -> None:
        """Drive for a period."""
        before, self.sight = self.sight.pose_xyyaw, self._world.step(speed_mps, turn_rate_rps)
        self._path_m += float(np.hypot(*(self.sight.pose_xyyaw - before)[:2]))
        self._collisions += self.sight.blocked and not self._touched
        self._touched = self.sight.blocked
        self._poses.append(self.sight.pose_xyyaw)
        self._hear()

    def explored(self) -> Explored:
        """What came of it."""
        path, coverage, times = np.array(self._rows).T
        truth, decisions = self._truth(), np.array(self._decisions_ms)
        errors, found = self._estimator.errors(truth), _trinary(self._estimator.aligned_cells(truth))
        if "ate_m" in errors:
            errors["ate_end_m"] = errors.pop("ate_m")
            errors |= {key: value for key, value in (self._enough or {}).items() if key == "ate_m"}
        true = _trinary(self._grid.cells(_OCCUPANCY))
        counted, in_reach = (self._collisions, self._ended), self._seen.in_reach(self._world).coverage(true)
        return Explored(path, coverage, times, truth.poses_xyyaw, decisions, *counted, found, true, in_reach, errors)


def _trinary(found: OccupancyMap) -> OccupancyMap:
    return found.trinary(_OCCUPANCY.free, _OCCUPANCY.occupied)


def _moved(before: np.ndarray, now: np.ndarray) -> bool:
    away = now - before
    return bool(
        math.hypot(away[0], away[1]) >= _MOVED_M or abs(math.remainder(float(away[2]), math.tau)) >= _TURNED_RAD
    )
