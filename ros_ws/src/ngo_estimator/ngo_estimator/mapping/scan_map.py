"""The map of a trajectory that is being corrected: it follows the poses, at a bounded cost an update."""

import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.data.relative_step import RESTART_AFTER_NS, RelativeStep
from ngo_estimator.data.state_arrays import Arrays, StateError, flat, part, require, split, taken, under
from ngo_estimator.mapping.occupancy_grid import MapTooLarge, OccupancyConfig, OccupancyGrid, OccupancyMap
from ngo_estimator.mapping.range_scan import Array, RangeScan, range_scan

_RAYS_AT_ONCE, _SCANS_AT_ONCE = 10_000, 256  # between two looks at the clock
_COARSEST = 32.0  # Times the cells that were asked for: a map that is still too large then has scans at absurd poses.


@dataclass(frozen=True)
class ScanMapConfig:
    """Which scans a map is made of. Its cost grows with the area, not with the time."""

    resolution_m: float = 0.05
    occupancy: OccupancyConfig = field(default_factory=OccupancyConfig)
    spacing_m: float = 0.2  # A scan is taken if the robot has moved by this since the last one, or turned by
    spacing_deg: float = 10.0  # this.
    place_m: float = 0.5  # A place is one square of this side, and one sector
    place_deg: float = 30.0  # of this angle.
    most_at_a_place: int = 8  # So many scans of a place are kept, the newest.
    moved_cells: float = 0.25  # A scan is entered anew once the ends of its rays have moved by this share of a cell.
    epoch_s: float = 600.0  # Scans within this count alike; older ones count less where these saw something else.
    most_waiting: int = 5000  # So many scans wait for their poses at most; then the oldest is given up.

    def __post_init__(self) -> None:
        check_positive(self, "resolution_m spacing_m spacing_deg place_m place_deg moved_cells epoch_s")
        check(self, "most_at_a_place most_waiting", "at least 1", lambda x: x >= 1)


@dataclass(frozen=True)
class MapUpdate:
    """What an update did: scans that were ``entered``, and ``moved`` or taken out, those ``left`` to move for lack of
    time, and whether a new trajectory began (``restarted``). ``too_large`` says why scans were left out, if any were.
    """

    entered: int
    moved: int
    left: int
    restarted: bool
    too_large: str = ""

    @property
    def changed(self) -> bool:
        """Whether any cell may have changed."""
        return bool(self.entered or self.moved or self.restarted)


class ScanMap:
    """Owns the grid, the scans in it and the poses at which each was entered.

    Scans wait until a trajectory says where they were taken, and leave with the frames that it lets go.

    Args:
        parts: whether parts of a trajectory may leave it and come again, as those of a robot among several: then scans
            before its first stamp wait as well.
    """

    def __init__(self, config: ScanMapConfig | None = None, parts: bool = False) -> None:
        self.config, self._parts = config or ScanMapConfig(), parts
        self._source: tuple[int, int] | None = None  # origin and newest stamp of the steps
        self._run = 0  # counts the starts of the source
        self._last_odom: Array | None = None  # of the frame whose scan was taken last
        self._waiting: dict[int, tuple[int, RangeScan]] = {}  # by stamp: the start of the source, and the scan
        self._restored = 0  # scans that were restored: they may wait beside the others
        self.lost = 0
        """Scans that waited in vain: no trajectory has their stamps."""
        self._forget()

    def __len__(self) -> int:
        return len(self._scans)

    @property
    def waiting(self) -> int:
        """Scans whose pose is not known yet."""
        return len(self._waiting)

    def _forget(self) -> None:
        self._grid = OccupancyGrid(self.config.resolution_m)
        self._span: tuple[int, int] | None = None  # first and last stamp of the trajectory
        self._map_run = self._run
        self._stamps = np.zeros(0, np.int64)
        self._poses = np.zeros((0, 3))  # at which each scan was entered
        self._reach = np.zeros(0)
        self._scans: list[RangeScan] = []
        self._places: defaultdict[tuple[int, ...], deque[int]] = defaultdict(deque)

    def take(self, step: RelativeStep, scans: Iterable[tuple[int, RangeScan]]) -> None:
        """Take the scans, each with its stamp, that came with a step; those too near the last one are left out."""
        if self._source is not None:
            origin, newest = self._source
            started = origin != step.origin_stamp_ns or step.stamp_ns <= newest - RESTART_AFTER_NS
            self._run += started and step.stamp_ns <= newest  # later stamps cannot be taken for earlier ones
            self._last_odom = None if started else self._last_odom
        self._source = step.origin_stamp_ns, step.stamp_ns
        scans = list(scans)
        if not scans or not self._is_elsewhere(step.odom_xyyaw):
            return
        self._last_odom = step.odom_xyyaw
        for stamp, scan in scans:
            self._waiting[stamp] = self._run, scan
        while len(self._waiting) > self.config.most_waiting + self._restored:
            self._waiting.pop(next(iter(self._waiting)))
            self.lost += 1

    def state(self) -> Arrays:
        """All scans in the map, and those that wait, for ``restore``; a trajectory says where they lie.

        Raises ``StateError`` where there are none.
        """
        waiting = {stamp: scan for stamp, (run, scan) in self._waiting.items() if run == self._map_run}
        known = sorted({**waiting, **dict(zip(self._stamps.tolist(), self._scans, strict=True))}.items())
        if not known:
            raise StateError("the map is empty; nothing was written")
        scans = [scan for _, scan in known]
        return {
            "stamps_ns": np.array([stamp for stamp, _ in known], np.int64),
            "sensors": np.array([scan.sensor_xyyaw for scan in scans], np.float64),
            **under("ends", flat([scan.ends for scan in scans], np.zeros((0, 2), np.float32))),
            **under("hits", flat([scan.hits for scan in scans], np.zeros(0, np.bool_))),
        }

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()``, in place of what is here; raises ``StateError``.

        The scans wait for the first trajectory that has their stamps.
        """
        stamps = taken(arrays, "stamps_ns", np.int64, -1)
        sensors = taken(arrays, "sensors", np.float64, len(stamps), 3)
        ends, hits = split(part(arrays, "ends"), np.float32, 2), split(part(arrays, "hits"), np.bool_)
        lengths = [len(ends), len(hits)] == [len(stamps)] * 2 and list(map(len, ends)) == list(map(len, hits))
        finite = all(bool(np.isfinite(values).all()) for values in (sensors, *ends))
        require(
            lengths and finite and bool((np.diff(stamps) > 0).all()), "stamps, ends and hits do not belong together"
        )
        self._source, self._last_odom = None, None
        self._forget()
        rows = zip(stamps.tolist(), map(RangeScan, sensors, ends, hits), strict=True)
        self._waiting = {stamp: (self._run, scan) for stamp, scan in rows}
        self._restored = len(stamps)

    def _is_elsewhere(self, odom: Array) -> bool:
        """Whether a frame is far enough from the last one whose scan was taken, by their poses ``(3,)`` in odom."""
        if self._last_odom is None:
            return True
        x, y, yaw = (odom - self._last_odom).tolist()
        turned = abs(math.remainder(yaw, 2.0 * math.pi))
        return math.hypot(x, y) >= self.config.spacing_m or turned >= math.radians(self.config.spacing_deg)

    def update(self, stamps_ns: np.ndarray, poses_xyyaw: Array, budget_s: float = math.inf) -> MapUpdate:
        """Follow a trajectory: enter the scans that wait for it, and move those whose poses it has changed.

        Args:
            stamps_ns: of all its frames ``(n,)``, increasing; poses_xyyaw: ``(n, 3)``. A trajectory with another first
                stamp, or one that ends sooner than the last one, begins a new map.
            budget_s: time after which the rest is left to the next update; scans that moved most go first.
        """
        deadline = time.monotonic() + budget_s
        restarted = self._begin_anew_for(stamps_ns)
        gone = 0 if self._parts else self._leave_out_all_but(stamps_ns)
        stamps, scans, poses = self._placed(stamps_ns, poses_xyyaw)
        entered, too_large = len(scans), self._fitting(lambda: self._enter(stamps, scans, poses))
        entered = 0 if too_large else entered
        now = poses_xyyaw[np.searchsorted(stamps_ns, self._stamps)]
        order, done, moved = self._moved_most_first(now), 0, gone
        while done < len(order) and time.monotonic() < deadline:
            rays = np.cumsum([len(self._scans[slot].ends) for slot in order[done : done + _SCANS_AT_ONCE]])
            some = order[done : done + max(1, int(np.searchsorted(rays, _RAYS_AT_ONCE)))]
            done += len(some)
            refused = self._fitting(partial(self._move, some, now[some]))
            moved += 0 if refused else len(some)
            too_large = refused or too_large
        return MapUpdate(entered, moved, len(order) - moved, restarted, too_large)

    @property
    def resolution_m(self) -> float:
        """Side of the map's cells: coarser than it was asked for where the map would be too large."""
        return self._grid.resolution_m

    def _fitting(self, change: Callable[[], None]) -> str:
        """Do a change, in a coarser map if it does not fit; returns why it could not be done, or nothing."""
        while True:
            try:
                change()
                return ""
            except MapTooLarge as error:
                resolution_m = max(error.coarser, 2.0) * self._grid.resolution_m
                if resolution_m > _COARSEST * self.config.resolution_m:
                    return str(error)
                self.redraw(resolution_m)

    def redraw(self, resolution_m: float) -> None:
        """Draw all scans anew in cells of another side (m); raises ``MapTooLarge``."""
        self._grid = OccupancyGrid(resolution_m)
        self._grid.add(self._scans, self._poses, self._epochs(self._stamps))

    def _moved_most_first(self, now: Array) -> np.ndarray:
        """Slots of the scans that have moved, by their poses now ``(scans, 3)``."""
        away = now - self._poses
        turned = np.abs(np.remainder(away[:, 2] + math.pi, 2.0 * math.pi) - math.pi)
        moved_m = np.hypot(away[:, 0], away[:, 1]) + turned * self._reach
        order = np.argsort(-moved_m, kind="stable")
        return order[: np.count_nonzero(moved_m > self.config.moved_cells * self._grid.resolution_m)]

    def cells(self, others: Sequence["ScanMap"] = ()) -> OccupancyMap:
        """The probabilities of the map's cells, by the scans of other maps of the same frame as well.

        Raises ``MapTooLarge`` for maps that lie too far apart.
        """
        grid = OccupancyGrid.summed([self._grid, *(other._grid for other in others)]) if others else self._grid
        return grid.cells(self.config.occupancy)

    def _begin_anew_for(self, stamps_ns: np.ndarray) -> bool:
        """Forget the map of another trajectory than this one; returns whether there was one."""
        first, last = int(stamps_ns[0]), int(stamps_ns[-1])
        restarted = self._span is not None and (first != self._span[0] or last < self._span[1])
        if restarted or self._span is None:
            if self._parts:
                self.withdraw()
            self._forget()
            self._waiting = {
                stamp: (run, scan)
                for stamp, (run, scan) in self._waiting.items()
                if run == self._run and (self._parts or stamp >= first)
            }
        self._span = first, last
        return restarted

    def _leave_out_all_but(self, stamps_ns: np.ndarray) -> int:
        """Drop scans of frames that a trajectory ``(n,)`` let go, or passed over; returns how many leave the map."""
        gone = self._stamps[~np.isin(self._stamps, stamps_ns)]
        self.withdraw(gone)
        run, last = self._map_run, int(stamps_ns[-1])
        due = np.array([stamp for stamp, (of, _) in self._waiting.items() if of == run and stamp <= last], np.int64)
        for stamp in due[~np.isin(due, stamps_ns)].tolist():
            self._waiting.pop(stamp)
        return len(gone)

    def _placed(self, stamps_ns: np.ndarray, poses: Array) -> tuple[np.ndarray, list[RangeScan], Array]:
        """Stamps ``(n,)``, scans and poses ``(n, 3)`` of those that waited, and whose poses are known now."""
        mine = np.array([stamp for stamp, (run, _) in self._waiting.items() if run == self._map_run], np.int64)
        mine.sort()
        at = np.minimum(np.searchsorted(stamps_ns, mine), len(stamps_ns) - 1)
        found = stamps_ns[at] == mine
        return mine[found], [self._waiting.pop(stamp)[1] for stamp in mine[found].tolist()], poses[at[found]]

    def _enter(self, stamps: np.ndarray, scans: list[RangeScan], poses: Array) -> None:
        if not scans:
            return
        self._grid.add(scans, poses, self._epochs(stamps))
        self._scans += scans
        self._stamps = np.concatenate((self._stamps, stamps))
        self._poses = np.concatenate((self._poses, poses))
        self._reach = np.concatenate((self._reach, [scan.reach_m for scan in scans]))
        unit = np.array((self.config.place_m, self.config.place_m, math.radians(self.config.place_deg)))
        sectors = round(2.0 * math.pi / unit[2])
        superseded = []
        for stamp, (x, y, sector) in zip(stamps.tolist(), np.floor(poses / unit).astype(int).tolist(), strict=True):
            place = self._places[x, y, sector % sectors]
            place.append(stamp)
            if len(place) > self.config.most_at_a_place:
                superseded.append(place.popleft())
        if superseded:
            self._remove(np.isin(self._stamps, superseded))

    def _remove(self, gone: np.ndarray) -> None:
        scans = [self._scans[slot] for slot in np.flatnonzero(gone)]
        self._grid.remove(scans, self._poses[gone], self._epochs(self._stamps[gone]))
        self._scans = [scan for scan, leaves in zip(self._scans, gone, strict=True) if not leaves]
        self._stamps, self._poses, self._reach = self._stamps[~gone], self._poses[~gone], self._reach[~gone]

    def withdraw(self, stamps_ns: np.ndarray | None = None) -> bool:
        """Let scans, of these stamps ``(n,)`` or all, wait for their poses again; returns whether there were any."""
        gone = np.isin(self._stamps, self._stamps if stamps_ns is None else stamps_ns)
        for slot in np.flatnonzero(gone).tolist():
            stamp = int(self._stamps[slot])
            self._waiting[stamp] = self._map_run, self._scans[slot]
        if gone.any():
            stay = set(self._stamps[~gone].tolist())
            for place in self._places.values():
                kept = [stamp for stamp in place if stamp in stay]
                place.clear()
                place.extend(kept)
            self._remove(gone)
        return bool(gone.any())

    def _move(self, slots: np.ndarray, poses: Array) -> None:
        scans, epochs = [self._scans[slot] for slot in slots], self._epochs(self._stamps[slots])
        self._grid.add(scans, poses, epochs)
        self._grid.remove(scans, self._poses[slots], epochs)
        self._poses[slots] = poses

    def _epochs(self, stamps_ns: np.ndarray) -> np.ndarray:
        """The epochs of scans with these stamps ``(n,)``."""
        epochs: np.ndarray = stamps_ns // round(1e9 * self.config.epoch_s)
        return epochs


def together(maps: Sequence[ScanMap]) -> OccupancyMap:
    """The map of the scans of several maps of one frame, all drawn in coarser cells where it would be too large.

    Raises ``MapTooLarge`` where even the coarsest cells are too many.
    """
    resolution_m = max(one.resolution_m for one in maps)
    while True:
        for one in maps:
            if one.resolution_m < resolution_m:
                one.redraw(resolution_m)
        try:
            return maps[0].cells(maps[1:])
        except MapTooLarge as error:
            resolution_m *= max(error.coarser, 2.0)
            if resolution_m > _COARSEST * maps[0].config.resolution_m:
                raise


def warm_up() -> None:
    """Compile all that a map needs: the first time it takes seconds."""
    grid = OccupancyGrid(1.0)
    scan = range_scan(np.zeros(1), np.ones(1), np.zeros(3), 2.0)
    grid.add([scan], np.zeros((1, 3)))
    grid.cells(OccupancyConfig())
