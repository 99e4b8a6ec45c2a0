"""What a row makes of a log after a change, kept on disk so that nothing is computed twice."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ngo_common.files import written_whole
from training.common.source_code import code_digest
from training.data import lidar_changes
from training.data.lidar_changes import OF_WHEELS, UNSEEDED, changed
from training.data.lidar_drives import Relations
from training.data.sensor_log import SensorLog
from training.recordings import lidar_logs
from training.recordings.lidar_logs import log_drive, log_identity, read_relations, relations_of
from training.scoring.lidar_rows import ROWS, DriveRuns, Estimate, identity_of
from training.scoring.lidar_scores import weights_digest
from training.scoring.relations import RelationErrors, interpolated, relation_errors

CLEAN = "clean"
BLIND_TO_WHEELS = ("ours_without_wheels", "kiss_icp")
"""Rows that no change of the wheels reaches."""
AT_SCANS_S = 0.02
"""A relation is at a scan where one was taken so close to each of its ends."""

_ALWAYS = (lidar_changes, lidar_logs)


@dataclass(frozen=True, eq=False)
class StressCell:
    """The estimate of one row on a log after one change.

    ``poses`` ``(n, 3)`` at ``taken_ns`` ``(n,)``, when their scans were really taken; ``kept_ns`` ``(k,)`` is when all
    scans that the change left were taken. ``scans_per_s`` is NaN where nothing is computed. ``failed`` says why there
    is no estimate.
    """

    taken_ns: np.ndarray
    poses: np.ndarray
    kept_ns: np.ndarray
    scans_per_s: float = np.nan
    failed: str = ""


class StressLog:
    """A log with relations, and what rows make of it; ``cache`` is a folder, ``weights`` one with our settings."""

    def __init__(self, path: Path, weights: Path, cache: Path) -> None:
        self.name = path.name.partition(".")[0]
        self._path, self._weights, self._cache = path, weights, cache

    @cached_property
    def relations(self) -> Relations:
        """What people found."""
        return read_relations(relations_of(self._path))

    @cached_property
    def _identity(self) -> str:
        return log_identity(self._path)

    @cached_property
    def _log(self) -> SensorLog:
        return SensorLog.of_drive(log_drive(self._path))

    def known(self, change: str, seed: int, name: str) -> StressCell | None:
        """What the row of this name made of the log before, by the code and the settings of today."""
        key = _as_seen(change, seed, name)
        path = self._file(*key)
        if not path.exists():
            return None
        with np.load(path) as stored:
            if str(stored["identity"]) != self._identity_of(*key):
                return None
            taken_ns, poses, kept_ns = (stored[part] for part in ("taken_ns", "poses", "kept_ns"))
            return StressCell(taken_ns, poses, kept_ns, float(stored["scans_per_s"]), str(stored["failed"]))

    def cells(self, change: str, seed: int, rows: Iterable[str]) -> Iterator[tuple[str, StressCell]]:
        """What each row makes of the log, which is changed only if a row is not known."""
        made: dict[tuple[str, int], tuple[SensorLog, DriveRuns]] = {}
        for name in rows:
            cell = self.known(change, seed, name)
            if cell is None:
                key = _as_seen(change, seed, name)
                if key[:2] not in made:
                    made[key[:2]] = self._made(*key[:2])
                cell = _cell(*made[key[:2]], name)
                self._write(cell, *key)
            yield name, cell

    def _made(self, change: str, seed: int) -> tuple[SensorLog, DriveRuns]:
        log = changed(self._log, change, seed)
        return log, DriveRuns(log.drive(f"{self.name}, {change}, {seed}", "", self.relations), self._weights)

    def _file(self, change: str, seed: int, name: str) -> Path:
        return self._cache / self.name / f"{change}.{seed}.{name}.npz"

    def _identity_of(self, change: str, seed: int, name: str) -> str:
        row = ROWS[name]
        code = code_digest((*_ALWAYS, *row.code))
        settings = identity_of(row.settings), weights_digest(row, self._weights)
        return json.dumps([name, change, seed, self._identity, code, *settings])

    def _write(self, cell: StressCell, change: str, seed: int, name: str) -> None:
        path, identity = self._file(change, seed, name), np.array(self._identity_of(change, seed, name))
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as file:
            np.savez(file, identity=identity, **vars(cell))


def _as_seen(change: str, seed: int, name: str) -> tuple[str, int, str]:
    """The change and the seed that give a row the same data."""
    change = CLEAN if change in OF_WHEELS and name in BLIND_TO_WHEELS else change
    return change, 0 if change in UNSEEDED else seed, name


def _cell(log: SensorLog, runs: DriveRuns, name: str) -> StressCell:
    try:
        found = ROWS[name].estimate(runs)
    except ValueError as error:
        return StressCell(np.zeros(0, np.int64), np.zeros((0, 3)), log.taken_ns, failed=str(error))
    assert isinstance(found, Estimate)  # only rows of wrong loops have several
    taken_ns = found.stamps_ns if name == "wheels" else log.taken_ns[np.searchsorted(log.stamps_ns, found.stamps_ns)]
    return StressCell(taken_ns, found.poses, log.taken_ns, found.scans_per_s or np.nan)


def cell_numbers(relations: Relations, cell: StressCell, clean: StressCell | None) -> dict[str, float]:
    """Mean errors over the relations by their key; what there is nothing for is left out.

    - ``translation_m``, ``rotation_deg``: over all relations within the estimate, ``relations`` of them;
      ``over_30_s_m``: over those that span more than 30 s.
    - ``at_scans_m``, ``at_scans_deg``: over those with a scan at both ends (``AT_SCANS_S``): elsewhere poses are
      interpolated.
    - ``best_possible_m``, ``best_possible_deg``: over all, of the poses without the change, ``clean``, read at the
      scans that were kept alone.
    """
    errors = _errors(relations, cell)
    within = len(errors.translation_m)
    numbers = {"translation_m": errors.translation_m, "rotation_deg": errors.rotation_deg}
    numbers["over_30_s_m"] = errors.translation_m[errors.far]
    kept_s = cell.kept_ns * 1e-9
    seen = (_away(relations.stamps_s, kept_s) < AT_SCANS_S).all(axis=1)
    if seen.any():
        errors = _errors(Relations(relations.stamps_s[seen], relations.relative_xyyaw[seen]), cell)
        numbers.update(at_scans_m=errors.translation_m, at_scans_deg=errors.rotation_deg)
    if clean is not None and not clean.failed:
        poses = interpolated(clean.taken_ns * 1e-9, clean.poses, kept_s)
        errors = _errors(relations, StressCell(cell.kept_ns, poses, cell.kept_ns))
        numbers.update(best_possible_m=errors.translation_m, best_possible_deg=errors.rotation_deg)
    means = {key: float(values.mean()) for key, values in numbers.items() if len(values)}
    means["relations"] = within
    return means | ({} if np.isnan(cell.scans_per_s) else {"scans_per_s": cell.scans_per_s})


def _errors(relations: Relations, cell: StressCell) -> RelationErrors:
    return relation_errors(relations, cell.taken_ns * 1e-9, cell.poses)


def _away(wanted_s: np.ndarray, stamps_s: np.ndarray) -> np.ndarray:
    """Time to the nearest of increasing stamps, of the shape of ``wanted_s``."""
    after = np.clip(np.searchsorted(stamps_s, wanted_s), 1, len(stamps_s) - 1)
    return np.minimum(np.abs(stamps_s[after] - wanted_s), np.abs(stamps_s[after - 1] - wanted_s))
