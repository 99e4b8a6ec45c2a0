"""The errors of a lidar's rows on drives, kept on disk so that nothing is computed twice."""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import numpy as np

from ngo_common.files import written_whole
from training.common.source_code import code_digest
from training.data import lidar_drives
from training.data.lidar_drives import LidarDrive, TruePoses
from training.scoring import lidar_errors as errors_module
from training.scoring import metrics, relations
from training.scoring.lidar_errors import Errors, covariance_errors, lidar_errors
from training.scoring.lidar_rows import DriveRuns, Estimate, Row, identity_of

_ALWAYS = (lidar_drives, errors_module, metrics, relations)
_MOST_DRAWN = 4000  # poses of a path in a picture


@dataclass(frozen=True)
class DriveSource:
    """A drive that is made when it is needed.

    ``identity`` says in words all that it follows from beside ``code``, the modules that make it.
    """

    name: str
    identity: str
    make: Callable[[], LidarDrive]
    code: tuple[ModuleType, ...]
    has_wheels: bool = True


@dataclass(frozen=True)
class Scored:
    """What a row makes of a drive.

    ``errors`` by the metric's key, each ``(samples,)``: of the whole trajectory, with ``online_`` as published at each
    scan, with ``odometry_`` of what the correction was given. ``path`` ``(n, 3)`` and ``walls`` ``(m, 2)`` are thinned
    for pictures, ``truth`` ``(k, 3)`` is empty where it is unknown. ``failed`` says why there is nothing.
    """

    errors: Errors = field(default_factory=dict)
    path: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    walls: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    truth: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    failed: str = ""


def score_drive(
    source: DriveSource, rows: dict[str, Row], weights: Path, cache: Path, known_only: bool = False
) -> Iterator[tuple[str, Scored]]:
    """What each row makes of a drive, from ``cache/DRIVE.ROW.npz`` where settings, drive and code are those of today.

    A row that the drive has no wheels for is left out; the drive is made only if a row is not known yet. With
    ``known_only`` such a row is left out, too.
    """
    runs: DriveRuns | None = None
    for name, row in rows.items():
        if row.needs_wheels and not source.has_wheels:
            continue
        path = cache / f"{source.name}.{name}.npz"
        code = code_digest((*_ALWAYS, *source.code, *row.code))
        identity = json.dumps([name, identity_of(row.settings), source.identity, code, weights_digest(row, weights)])
        known = _read(path, identity)
        if known is None and known_only:
            continue
        if known is None:
            runs = runs or DriveRuns(source.make(), weights)
            known = _scored(runs, row)
            _write(path, identity, known)
        yield name, known


def _scored(runs: DriveRuns, row: Row) -> Scored:
    drive = runs.drive
    if row.needs_wheels and not drive.wheels:
        return Scored(failed=f"{drive.name} has no wheel odometry")
    try:
        found = row.estimate(runs)
        estimates = found if isinstance(found, list) else [found]
        each = [_errors(drive, estimate) for estimate in estimates]
    except ValueError as error:
        return Scored(failed=str(error))
    errors = {key: np.mean([errors[key] for errors in each], axis=0) for key in each[0]}
    estimate = estimates[0]
    truth = drive.reference.poses_xyyaw if isinstance(drive.reference, TruePoses) else np.zeros((0, 3))
    walls = np.zeros((0, 2)) if estimate.walls is None else estimate.walls
    return Scored(errors, _thinned(estimate.poses), walls, _thinned(truth))


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
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(weights.iterdir()))).hexdigest()


def _read(cache: Path, identity: str) -> Scored | None:
    if not cache.exists():
        return None
    with np.load(cache) as stored:
        if str(stored["identity"]) != identity:
            return None
        errors = {name[6:]: stored[name] for name in stored.files if name.startswith("error:")}
        return Scored(errors, stored["path"], stored["walls"], stored["truth"], str(stored["failed"]))


def _write(cache: Path, identity: str, scored: Scored) -> None:
    cache.parent.mkdir(parents=True, exist_ok=True)
    errors = {f"error:{name}": values for name, values in scored.errors.items()}
    drawn = {name: getattr(scored, name).astype(np.float32) for name in ("path", "walls", "truth")}
    with written_whole(cache) as file:
        np.savez(file, identity=np.array(identity), failed=np.array(scored.failed), **drawn, **errors)  # type: ignore[arg-type]
