"""Localisation in real logs of a lidar: the first half of a drive is the map, robots start in the second half."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.slam.localisation import Localiser
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.scan_matcher import ScanMatcher
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from training.data.lidar_drives import LidarDrive
from training.scoring.kidnapped import MOST_DEG, MOST_M, KnownMap, MapErrors
from training.scoring.lidar_rows import DriveRuns, Pipeline

WAY_M = 30.0  # Way of a start.

_MAPPED_WAY_M = 10.0  # of a start that must lie where the map has key scans
_LEAST_MAPPED = 0.9
_THINNED = 5  # one of so many frames of the map says where it lies


@dataclass(frozen=True)
class LogStart:
    """A start: whether its first 10 m lie where the map does, and what came out.

    ``claimed`` says whether a pose was claimed within ``WAY_M``, ``right`` whether the first one was, ``way_m`` after
    how much way. ``processor_s_per_m`` is the localiser's time up to then.
    """

    mapped: bool
    claimed: bool
    right: bool
    way_m: float
    processor_s_per_m: float


def log_starts(drive: LidarDrive, weights: Path, count: int) -> Iterator[LogStart]:
    """``count`` starts of a log, evenly over its second half.

    There is no truth that is good enough: a pose is right where the map of the whole drive has the robot, which the map
    of the first half need not be part of. Both begin at the same pose.
    """
    run = DriveRuns(drive, weights).run(Pipeline())
    steps, whole = run.front.steps, run.trajectory.poses_xyyaw
    half = len(steps) // 2
    mapped = ScanTrajectory.load(weights)
    for step in steps[:half]:
        mapped.update(step)
    mapped.finish()
    first = mapped.trajectory()
    assert first is not None
    thinned = slice(None, None, _THINNED)
    known = KnownMap(first.poses_xyyaw[thinned], whole[: half + 1][thinned], np.zeros((0, 0)), ScanMatcher.place_m)
    errors = MapErrors(known, whole)
    away_m = KDTree(known.truth[:, :2]).query(whole[:, :2])[0]
    way_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(whole[:, :2], axis=0), axis=1)))
    ends = np.searchsorted(way_m, way_m[-1] - WAY_M)
    matcher = mapped.back_end.matcher(MapOrigin.of_first_pose(np.zeros(3)))
    for start in np.linspace(half, max(half, int(ends) - 1), count).astype(np.int64).tolist():
        shown = away_m[start : int(np.searchsorted(way_m, way_m[start] + _MAPPED_WAY_M))] <= 2.0 * ScanMatcher.place_m
        yield _start(Localiser(matcher), errors, steps, way_m, start, bool(shown.mean() >= _LEAST_MAPPED))


def as_arrays(starts: list[LogStart]) -> dict[str, np.ndarray]:
    """The starts as arrays ``(starts,)``, to be kept."""
    return {field.name: np.array([getattr(start, field.name) for start in starts]) for field in fields(LogStart)}


def starts_of(arrays: dict[str, np.ndarray]) -> list[LogStart]:
    """The starts that ``as_arrays`` made arrays of."""
    columns = (arrays[field.name].tolist() for field in fields(LogStart))
    return [LogStart(*values) for values in zip(*columns, strict=True)]


def summary_of(starts: list[LogStart]) -> dict[str, Any]:
    """Counts of starts in mapped parts and elsewhere, and the median way to a right claim."""
    result: dict[str, Any] = {}
    for name, some in (("mapped", [x for x in starts if x.mapped]), ("unmapped", [x for x in starts if not x.mapped])):
        paths_m = [start.way_m for start in some if start.right]
        result[name] = {
            "starts": len(some),
            "right": len(paths_m),
            "false_claims": sum(start.claimed and not start.right for start in some),
            "way_to_success_m": float(np.median(paths_m)) if paths_m else None,
            "processor_s_per_m": float(np.mean([start.processor_s_per_m for start in some])) if some else None,
        }
    return result


def _start(
    localiser: Localiser, errors: MapErrors, steps: list[RelativeStep], way_m: np.ndarray, start: int, mapped: bool
) -> LogStart:
    localiser.reset()
    began, gone_m = time.process_time(), 0.0
    for number in range(start, len(steps)):
        if way_m[number + 1] - way_m[start] > WAY_M:
            break
        gone_m = float(way_m[number + 1] - way_m[start])
        step = steps[number]
        pose = localiser.update(step, step.relative_xyyaw, step.covariance).pose_xyyaw
        if pose is not None:
            metres, degrees = errors.of(number + 1, pose)
            right = metres <= MOST_M and degrees <= MOST_DEG
            return LogStart(mapped, True, right, gone_m, _per_m(began, gone_m))
    return LogStart(mapped, False, False, math.nan, _per_m(began, gone_m))


def _per_m(began_s: float, gone_m: float) -> float:
    return (time.process_time() - began_s) / max(gone_m, 1.0)
