"""The lidar's rows as rows of a table: the errors of what they estimate, and what is drawn of it."""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from training.data import lidar_drives
from training.data.lidar_drives import LidarDrive, TruePoses
from training.scoring import lidar_errors as errors_module
from training.scoring import metrics, relations, table
from training.scoring.lidar_errors import Errors, covariance_errors, lidar_errors
from training.scoring.lidar_rows import DriveRuns, Estimate, Row, identity_of
from training.scoring.table import Drive, Measured, folder_digest

_ALWAYS = (lidar_drives, errors_module, metrics, relations)
_MOST_DRAWN = 4000  # poses of a path in a picture


def with_runs(drive: Drive, weights: Path) -> Drive:
    """A drive that makes a ``LidarDrive``, for ``scored_rows``: its rows share the runs of our estimators."""
    return replace(drive, make=lambda: DriveRuns(drive.make(), weights))


def scored_rows(rows: Mapping[str, Row], weights: Path) -> dict[str, table.Row]:
    """Rows that measure drives ``with_runs``."""
    return {
        name: table.Row(
            partial(scored, row=row),
            json.dumps([identity_of(row.settings), weights_digest(row, weights)]),
            (*_ALWAYS, *row.code),
        )
        for name, row in rows.items()
    }


def scored(runs: DriveRuns, row: Row) -> Measured:
    """What a row makes of a drive.

    Errors of the whole trajectory, with ``online_`` as published at each scan, with ``odometry_`` of what the
    correction was given. Drawn: ``path`` ``(n, 3)`` and ``truth`` ``(k, 3)``, thinned, and ``walls`` ``(m, 2)``; empty
    where there is none.
    """
    drive = runs.drive
    if row.needs_wheels and not drive.wheels:
        return Measured(failed=f"{drive.name} has no wheel odometry")
    try:
        found = row.estimate(runs)
        estimates = found if isinstance(found, list) else [found]
        each = [_errors(drive, estimate) for estimate in estimates]
    except ValueError as error:
        return Measured(failed=str(error))
    errors = {key: np.mean([errors[key] for errors in each], axis=0) for key in each[0]}
    estimate = estimates[0]
    truth = drive.reference.poses_xyyaw if isinstance(drive.reference, TruePoses) else np.zeros((0, 3))
    walls = np.zeros((0, 2)) if estimate.walls is None else estimate.walls
    drawn = {"path": _thinned(estimate.poses), "walls": walls, "truth": _thinned(truth)}
    return Measured(errors, {name: array.astype(np.float32) for name, array in drawn.items()})


def _errors(drive: LidarDrive, estimate: Estimate) -> Errors:
    known = drive.reference is not None
    errors = lidar_errors(drive.reference, estimate.stamps_ns, estimate.poses) if known else {}
    for name, poses in (("online", estimate.online), ("odometry", estimate.odometry)):
        if poses is not None and known:
            found = lidar_errors(drive.reference, estimate.stamps_ns, poses)
            errors.update({f"{name}_{key}": values for key, values in found.items()})
    if isinstance(drive.reference, TruePoses) and estimate.online is not None and estimate.covariances is not None:
        errors.update(covariance_errors(drive.reference, estimate.stamps_ns, estimate.online, estimate.covariances))
    if estimate.scans_per_s is not None:
        errors["scans_per_s"] = np.array([estimate.scans_per_s])
    errors.update({name: np.array([float(value)]) for name, value in estimate.facts.items()})
    return errors


def _thinned(poses: np.ndarray) -> np.ndarray:
    return poses[:: max(1, -(-len(poses) // _MOST_DRAWN))]


def weights_digest(row: Row, weights: Path) -> str:
    """A hash of the shipped settings, for a row of our own estimators."""
    if not any(module.__name__.startswith("ngo_estimator.") for module in row.code):
        return ""
    return folder_digest(weights)
