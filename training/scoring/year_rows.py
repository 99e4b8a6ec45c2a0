"""A robot that patrols one building for a year: each drive begins with what the one before left on disk."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ngo_common.files import written_whole
from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.geometry import se2
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.mapping.occupancy_grid import OccupancyGrid
from ngo_estimator.mapping.range_scan import range_scan
from ngo_estimator.mapping.scan_map import ScanMap
from ngo_estimator.mapping.scan_source import KeyScans
from ngo_estimator.slam.map_localisation import MapLocalisation
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.saved_state import read_state, write_state
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.session import Session
from ngo_estimator.slam.tf_smoothing import SmoothedCorrection
from training.data.lidar_drives import TruePoses
from training.data.year_drives import YearDrive, year_drive
from training.scoring.lidar_rows import DriveRuns, Pipeline
from training.scoring.map_errors import intersections
from training.scoring.metrics import absolute_error_m, position_rmse_m, rigid_motion
from training.scoring.table import Measured, Numbers, intervals, read, write

IN_TIME, MOST_SCANS = 50, 300
"""Scans within which a robot should be localised, and for how many it looks for itself."""

MOST_M, MOST_DEG = 0.5, 5.0
"""Errors up to which a claimed pose is right."""

_MAPPED_M, _LEAST_MAPPED = 2.0, 0.9  # share of a start's frames that are so near to the ways before
_MAP_EVERY = 50  # scans between two updates of the map
_MAP_IDENTITY = {"map": "scan", "max_range": 0.0}


@dataclass(frozen=True)
class Year:
    """A year in the building of ``seed``: so many ``drives`` of ``scans`` each, and ``starts`` in each drive at which a
    robot looks for itself in the map so far. Old key scans leave the graph from ``most_scans`` on. What is done is kept
    in ``folder``.
    """

    seed: int
    drives: int
    scans: int
    starts: int
    most_scans: int
    weights: Path
    folder: Path


def patrol(year: Year, identity: str) -> Measured:
    """All numbers of each drive ``(drives,)``; NaN where a drive has none.

    ``ate_m``: error of the drive's poses from where the robot was found on, in the map as a whole; ``drive_ate_m`` with
    that part of the drive aligned by itself, and ``alone_ate_m`` of the same part where the drive is mapped alone.
    ``iou``: of the map's free cells with those of the building as it is now, and ``occupied_iou`` of the others; with
    ``_of_sums`` where all scans count alike.
    ``ms_a_scan``: computing time of odometry and correction, and ``map_ms_a_scan`` of the map. ``memory_mb``: size of
    all that a saved state holds. ``nodes``: of the graph. ``load_s``: time to load the state. Of the starts, the
    ``localised_share`` was found within 50 scans, the ``found_share`` within 300, in the mean after ``scans_to_claim``.
    ``false_claims``: of all starts, and of the drive itself. ``joined``: whether the map went on with the drive.
    """
    found: list[Measured] = []
    identity = f"{identity} {year.scans} {year.starts} {year.most_scans}"
    # A year goes on from its own states alone: those of other settings or code lie elsewhere.
    year = replace(year, folder=year.folder / hashlib.sha256(identity.encode()).hexdigest()[:12])
    for number in range(year.drives):
        path = year.folder / f"drive_{number:03d}.npz"
        known = read(path, f"{identity} {number}")
        if known is None:
            known = _Drive(year, number).measured()
            write(path, f"{identity} {number}", known)
        found.append(known)
    nothing = np.full(1, np.nan)
    keys = {key: None for one in found for key in one.errors}
    errors = {key: np.concatenate([one.errors.get(key, nothing) for one in found]) for key in keys}
    shown = {"first": 0, "middle": year.drives // 2, "last": year.drives - 1}
    return Measured(
        errors, {f"{key}_{name}": value for key, n in shown.items() for name, value in found[n].drawn.items()}
    )


_ROWS = {"first_ten": slice(0, 10), "eleven_to_twenty": slice(10, 20), "last_ten": slice(-10, None)}


def year_numbers(years: Sequence[Measured]) -> dict[str, Numbers]:
    """By row, of ten drives each, the mean of each number over the drives of all years."""
    return {row: intervals({key: _of(years, key, which) for key in years[0].errors}) for row, which in _ROWS.items()}


def year_ratios(years: Sequence[Measured]) -> Numbers:
    """Numbers of the last ten drives as a share of what they are compared with, one of each year; none of a year in
    which both are the same drives. ``of_alone``: of the error of each drive, that of the same drive alone."""
    last, pairs = _ROWS["last_ten"], {}
    second, first = "eleven_to_twenty", "first_ten"
    for key, row in (("memory_mb", second), ("ms_a_scan", second), ("ate_m", first), ("drive_ate_m", first)):
        before = _ROWS[row]
        pairs[key] = [
            (_of([year], key, last), _of([year], key, before))
            for year in years
            if len(year.errors[key]) >= 10 + (before.stop or 0)
        ]
    pairs["of_alone"] = [(_of([year], "drive_ate_m", last), _of([year], "alone_ate_m", last)) for year in years]
    return intervals(
        {key: np.array([a.mean() / b.mean() for a, b in both if len(a) and len(b)]) for key, both in pairs.items()}
    )


def year_least(years: Sequence[Measured]) -> dict[str, float]:
    """The least IoU of free cells after any drive of any year."""
    return {"iou": float(_of(years, "iou", slice(None)).min())}


def _of(years: Sequence[Measured], key: str, which: slice) -> np.ndarray:
    """A number of some drives of all years, of those that have it ``(n,)``."""
    values = np.concatenate([year.errors[key][which] for year in years])
    return np.asarray(values[np.isfinite(values)])


class _Drive:
    """One drive of the year, and what the robot knows in it."""

    def __init__(self, year: Year, number: int) -> None:
        self._year, self._number = year, number
        self._drive: YearDrive = year_drive(year.seed, number, year.scans)
        reference = self._drive.measured.reference
        assert isinstance(reference, TruePoses)
        self._truth = reference
        self._runs = DriveRuns(self._drive.measured, year.weights)
        self._front = self._runs.front(Pipeline())
        self._map, self._map_s = ScanMap(), 0.0
        config = replace(read_lidar_file(year.weights, "graph", ScanGraphConfig), most_scans=year.most_scans)
        self._session = Session("scan", ScanTrajectory(config), MapOrigin(np.zeros(3)), SmoothedCorrection(0.0))
        self._known = TruePoses(np.zeros(0, np.int64), np.zeros((0, 3)))  # of scans in the map

    def measured(self) -> Measured:
        """Load the state, look for the robot, go on, and save the state."""
        self._false = 0
        numbers = self._looked() if self._number else {}
        began = time.process_time()
        joined = self._go_on()
        took_s = time.process_time() - began - self._map_s
        numbers["ms_a_scan"] = 1e3 * (took_s + self._front.took_s) / self._year.scans
        numbers["map_ms_a_scan"] = 1e3 * self._map_s / self._year.scans
        trajectory, graph = self._session.core.trajectory(), self._session.core.planar_graph()
        assert trajectory is not None and graph is not None
        self._map.update(trajectory.stamps_ns, trajectory.poses_xyyaw)
        self._learn_truth()
        numbers["joined"] = float(joined is not None)
        numbers["nodes"] = float(len(graph.ids))
        if joined is not None:
            own = np.flatnonzero(trajectory.stamps_ns >= joined)
            stamps_ns, poses = trajectory.stamps_ns[own], trajectory.poses_xyyaw[own]
            truth, alone = self._truth_at(stamps_ns), self._runs.run(Pipeline()).trajectory
            numbers["ate_m"] = position_rmse_m(poses, se2.compose(self._map_from_truth(), truth))
            numbers["drive_ate_m"] = absolute_error_m(poses, truth)
            same = np.searchsorted(alone.stamps_ns, stamps_ns)
            numbers["alone_ate_m"] = absolute_error_m(alone.poses_xyyaw[same], truth)
        numbers["false_claims"] = float(self._false)
        drawn = self._map_errors(numbers)
        numbers["memory_mb"] = self._save()
        return Measured.of(numbers, **drawn)

    def _looked(self) -> dict[str, float]:
        """Load the state, and look for the robot from each start."""
        began = time.process_time()
        self._session = self._session.loaded(self._folder(-1) / "session")
        numbers = {"load_s": time.process_time() - began}
        self._map.restore(read_state(self._folder(-1) / "scans", _MAP_IDENTITY))
        with np.load(self._folder(-1) / "truth.npz") as kept:
            self._known = TruePoses(kept["stamps_ns"], kept["poses_xyyaw"])
        steps, self._found_at = self._front.steps, self._map_from_truth()
        known_places, search = KDTree(self._known.poses_xyyaw[:, :2]), self._session.localisation()
        near = known_places.query(self._truth.poses_xyyaw[:, :2])[0] <= _MAPPED_M
        claims: list[tuple[bool, int]] = []
        for start in np.linspace(0, len(steps) - MOST_SCANS, self._year.starts, endpoint=False).astype(int).tolist():
            if near[start : start + MOST_SCANS].mean() >= _LEAST_MAPPED:
                claims.append(self._claim(search, start))
        if claims:
            right, scans = (np.array(column) for column in zip(*claims, strict=True))
            numbers["localised_share"] = float((right & (scans <= IN_TIME)).mean())
            numbers["found_share"] = float(right.mean())
            if right.any():
                numbers["scans_to_claim"] = float(scans[right].mean())
            self._false = int((~right & (scans < MOST_SCANS)).sum())
        return numbers

    def _claim(self, search: MapLocalisation, start: int) -> tuple[bool, int]:
        """Whether the first pose claimed from a start is right, and after how many scans; ``MOST_SCANS`` if none is."""
        search.reset()
        for number, step in enumerate(self._front.steps[start : start + MOST_SCANS]):
            pose = search.update(step).found.pose_xyyaw
            if pose is not None:
                return self._is_right(step.stamp_ns, pose), number
        return False, MOST_SCANS

    def _is_right(self, stamp_ns: int, pose: np.ndarray) -> bool:
        off = se2.between(se2.compose(self._found_at, self._truth_at(np.array((stamp_ns,)))[0]), pose)
        return bool(np.hypot(off[0], off[1]) <= MOST_M and abs(np.degrees(off[2])) <= MOST_DEG)

    def _go_on(self) -> int | None:
        """Take all steps; returns the stamp from which on the map has the drive, None if the robot was not found."""
        core, joining = self._session.core, self._session.joining() if self._number else None
        joined = None if self._number else int(self._front.steps[0].stamp_ns)
        for number, step in enumerate(self._front.steps):
            self._map.take(step, KeyScans().scans(step))
            if joining is None:
                core.update(step)
                core.correct()
            else:
                found = joining.update(step)
                if found.joined is not None:
                    joining, joined = None, int(step.stamp_ns)
                    assert found.found.pose_xyyaw is not None
                    self._false += not self._is_right(joined, found.found.pose_xyyaw)
            if joining is None and number % _MAP_EVERY == 0:
                began = time.process_time()
                trajectory = core.trajectory()
                assert trajectory is not None
                self._map.update(trajectory.stamps_ns, trajectory.poses_xyyaw)
                self._map.cells()
                self._map_s += time.process_time() - began
        core.finish()
        return joined

    def _truth_at(self, stamps_ns: np.ndarray) -> np.ndarray:
        return np.asarray(self._truth.poses_xyyaw[np.searchsorted(self._truth.stamps_ns, stamps_ns)])

    def _map_from_truth(self) -> np.ndarray:
        """The motion ``(3,)`` that carries true poses into the map, by the scans that are in it."""
        trajectory = self._session.core.trajectory()
        assert trajectory is not None
        at = np.searchsorted(trajectory.stamps_ns, self._known.stamps_ns)
        return rigid_motion(self._known.poses_xyyaw[:, :2], trajectory.poses_xyyaw[at, :2])

    def _learn_truth(self) -> None:
        """Keep the true poses of the scans that are in the map now."""
        stamps_ns = self._map.state()["stamps_ns"]
        trajectory = self._session.core.trajectory()
        assert trajectory is not None
        placed = stamps_ns[np.isin(stamps_ns, trajectory.stamps_ns)]
        own = np.isin(placed, self._truth.stamps_ns)
        before = np.searchsorted(self._known.stamps_ns, placed[~own])
        poses = np.concatenate((self._known.poses_xyyaw[before], self._truth_at(placed[own])))
        self._known = TruePoses(placed, poses)  # stamps ascend, and this drive is the last

    def _map_errors(self, numbers: dict[str, float]) -> dict[str, np.ndarray]:
        """Compare the map with what exact scans from the same true poses show of the building as it is now."""
        angles, ranges, sensor = self._drive.exact_scans(self._known.stamps_ns, self._known.poses_xyyaw)
        most_m = self._drive.building.scanner.range_max_m
        scans = [range_scan(angles, seen.astype(np.float64), sensor, most_m) for seen in ranges]
        grid, config = OccupancyGrid(self._map.resolution_m), self._map.config.occupancy
        grid.add(scans, se2.compose(self._map_from_truth(), self._known.poses_xyyaw))
        one, other = (each.trinary(config.free, config.occupied) for each in (self._map.cells(), grid.cells(config)))
        numbers["iou"], numbers["occupied_iou"] = intersections(one, other)
        self._map.config = replace(self._map.config, occupancy=replace(config, settled=math.inf))
        unsettled = self._map.cells().trinary(config.free, config.occupied)
        numbers["iou_of_sums"], numbers["occupied_iou_of_sums"] = intersections(unsettled, other)
        return {"found": one.values, "true": other.values, "corners": np.stack((one.origin_xy, other.origin_xy))}

    def _folder(self, further: int) -> Path:
        """Where the state after this drive is kept, or after one before: two of them in turn."""
        return self._year.folder / f"state_{(self._number + further) % 2}"

    def _save(self) -> float:
        """Save the state; returns its size in MB."""
        folder = self._folder(0)
        folder.mkdir(parents=True, exist_ok=True)
        session, scans = self._session.state(), self._map.state()
        self._session.write(folder / "session", session)
        write_state(folder / "scans", _MAP_IDENTITY, scans)
        with written_whole(folder / "truth.npz") as file:
            np.savez(file, stamps_ns=self._known.stamps_ns, poses_xyyaw=self._known.poses_xyyaw)
        return 1e-6 * sum(array.nbytes for array in (*session.values(), *scans.values()))
