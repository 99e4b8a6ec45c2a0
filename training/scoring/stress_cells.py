"""What rows make of a log after a change: drives and rows of this table, and the numbers of a cell."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from training.data import lidar_changes
from training.data.lidar_changes import OF_WHEELS, UNSEEDED, changed
from training.data.lidar_drives import Relations
from training.data.sensor_log import SensorLog
from training.recordings import lidar_logs
from training.recordings.lidar_logs import log_drive, log_identity, read_relations, relations_of
from training.scoring.lidar_rows import FRONT_ABLATION, ROWS, DriveRuns, Estimate, identity_of
from training.scoring.lidar_scores import weights_digest
from training.scoring.relations import interpolated, relation_errors
from training.scoring.table import Drive, Measured, Row, measure

CLEAN = "clean"
BLIND_TO_WHEELS = ("ours_without_wheels", "kiss_icp")  # Rows that no change of the wheels reaches.
AT_SCANS_S = 0.02  # A relation is at a scan where one was taken so close to each of its ends.

_CODE = (lidar_changes, lidar_logs)
_ROWS = ROWS | FRONT_ABLATION


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

    def cells(self, change: str, seed: int, rows: Iterable[str], known_only: bool = False) -> dict[str, Measured]:
        """What each row makes of the log after a change; with ``known_only`` what the code of today made before.

        Drawn of a cell: ``poses`` ``(n, 3)`` at ``taken_ns`` ``(n,)``, when their scans were really taken, and
        ``kept_ns`` ``(k,)``, when all scans that the change left were. Its only error is ``scans_per_s``, where
        something is computed.
        """
        seen = {name: CLEAN if change in OF_WHEELS and name in BLIND_TO_WHEELS else change for name in rows}
        plan = [
            (
                self._drive(one, 0 if one in UNSEEDED else seed),
                {name: self._row(name) for name in seen if seen[name] == one},
            )
            for one in dict.fromkeys(seen.values())
        ]
        found = measure(plan, self._cache / self.name, known_only=known_only)
        return {name: cells[name] for name in seen for cells in found.values() if name in cells}

    def _drive(self, change: str, seed: int) -> Drive:
        seed = 0 if change in UNSEEDED else seed
        identity = f"{self._identity}, {change}, {seed}"
        return Drive(f"{change}.{seed}", identity, partial(self._made, change, seed), _CODE)

    def _made(self, change: str, seed: int) -> tuple[SensorLog, DriveRuns]:
        log = changed(self._log, change, seed)
        return log, DriveRuns(log.drive(f"{self.name}, {change}, {seed}", "", self.relations), self._weights)

    def _row(self, name: str) -> Row:
        row = _ROWS[name]
        identity = json.dumps([identity_of(row.settings), weights_digest(row, self._weights)])
        return Row(partial(_cell, name=name), identity, row.code)


def _cell(made: tuple[SensorLog, DriveRuns], name: str) -> Measured:
    log, runs = made
    try:
        found = _ROWS[name].estimate(runs)
    except ValueError as error:
        return cell_of(log.taken_ns[:0], np.zeros((0, 3)), log.taken_ns, failed=str(error))
    assert isinstance(found, Estimate)  # only rows of wrong loops have several
    taken_ns = found.stamps_ns if name == "wheels" else log.taken_ns[np.searchsorted(log.stamps_ns, found.stamps_ns)]
    return cell_of(taken_ns, found.poses, log.taken_ns, found.scans_per_s)


def cell_of(
    taken_ns: np.ndarray, poses: np.ndarray, kept_ns: np.ndarray, scans_per_s: float | None = None, failed: str = ""
) -> Measured:
    """A cell, as ``StressLog.cells`` has them."""
    errors = {} if scans_per_s is None else {"scans_per_s": np.array([scans_per_s])}
    return Measured(errors, {"taken_ns": taken_ns, "poses": poses, "kept_ns": kept_ns}, failed)


def cell_numbers(relations: Relations, cell: Measured, clean: Measured | None) -> dict[str, float]:
    """Mean errors over the relations by their key; what there is nothing for is left out.

    - ``translation_m``, ``rotation_deg``: over all relations within the estimate, ``relations`` of them;
      ``over_30_s_m``: over those that span more than 30 s.
    - ``at_scans_m``, ``at_scans_deg``: over those with a scan at both ends (``AT_SCANS_S``): elsewhere poses are
      interpolated.
    - ``best_possible_m``, ``best_possible_deg``: over all, of the poses without the change, ``clean``, read at the
      scans that were kept alone.
    """
    taken_s, poses, kept_s = cell.drawn["taken_ns"] * 1e-9, cell.drawn["poses"], cell.drawn["kept_ns"] * 1e-9
    errors = relation_errors(relations, taken_s, poses)
    within = len(errors.translation_m)
    numbers = {"translation_m": errors.translation_m, "rotation_deg": errors.rotation_deg}
    numbers["over_30_s_m"] = errors.translation_m[errors.far]
    seen = (_away(relations.stamps_s, kept_s) < AT_SCANS_S).all(axis=1)
    if seen.any():
        of_seen = Relations(relations.stamps_s[seen], relations.relative_xyyaw[seen])
        errors = relation_errors(of_seen, taken_s, poses)
        numbers.update(at_scans_m=errors.translation_m, at_scans_deg=errors.rotation_deg)
    if clean is not None and not clean.failed:
        poses = interpolated(clean.drawn["taken_ns"] * 1e-9, clean.drawn["poses"], kept_s)
        errors = relation_errors(relations, kept_s, poses)
        numbers.update(best_possible_m=errors.translation_m, best_possible_deg=errors.rotation_deg)
    means = {key: float(values.mean()) for key, values in numbers.items() if len(values)}
    means["relations"] = within
    return means | {key: float(values.mean()) for key, values in cell.errors.items()}


def _away(wanted_s: np.ndarray, stamps_s: np.ndarray) -> np.ndarray:
    """Time to the nearest of increasing stamps, of the shape of ``wanted_s``."""
    after = np.clip(np.searchsorted(stamps_s, wanted_s), 1, len(stamps_s) - 1)
    return np.minimum(np.abs(stamps_s[after] - wanted_s), np.abs(stamps_s[after - 1] - wanted_s))
