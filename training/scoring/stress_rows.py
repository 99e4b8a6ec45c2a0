"""Rows of the tables of simulated stress and of the car: estimates with the numbers that these tables alone need."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from scipy.spatial import KDTree

from ngo_estimator.frontend.lidar import mixture_lidar
from ngo_estimator.geometry.planar_motion import all_between
from ngo_estimator.graph.relative_poses import BELIEVED
from ngo_estimator.slam import scan_trajectory
from training.baselines.lidar_peers import scan_points
from training.data.batches import seen_from_first
from training.data.lidar_drives import LidarDrive, TruePoses
from training.scoring import second_visit as second_visit_module
from training.scoring.kidnapped import MOST_DEG, MOST_M
from training.scoring.lidar_rows import ROWS, DriveRuns, Estimate, Pipeline, Row, ours
from training.scoring.relations import interpolated
from training.scoring.second_visit import second_visit

Facts = Callable[[LidarDrive, np.ndarray], Mapping[str, float]]
"""Numbers of a drive and the poses ``(scans, 3)`` at its scans that a row gives it."""

_LOOP_WAY_M = 50.0
_SAME_PLACE_M = 1.0
_EVERY_M = 0.5
_LAST_VISITS = 10


def with_facts(name: str, facts: Facts) -> Row:
    """The row of this name in ``ROWS``, with numbers of its poses."""
    row = ROWS[name]
    code = (*row.code, second_visit_module)
    return dataclasses.replace(row, estimate=partial(_estimate_with, name=name, facts=facts), code=code)


def _estimate_with(runs: DriveRuns, name: str, facts: Facts) -> Estimate:
    found = ROWS[name].estimate(runs)
    assert isinstance(found, Estimate)  # only rows of wrong loops have several
    stamps_ns, first_ns = runs.drive.scan_stamps_ns, runs.drive.scan_stamps_ns[0]
    poses = interpolated((found.stamps_ns - first_ns) * 1e-9, found.poses, (stamps_ns - first_ns) * 1e-9)
    return dataclasses.replace(found, facts={**found.facts, **facts(runs.drive, poses)})


def loop_facts(drive: LidarDrive, poses: np.ndarray) -> dict[str, float]:
    """``largest_m``, the largest error with the first pose right, and ``last_loop_m``, as ``last_loop_error_m``."""
    truth = _truth(drive).poses_xyyaw
    off_m = np.hypot(*(seen_from_first(poses) - seen_from_first(truth))[:, :2].T)
    return {"largest_m": float(off_m.max()), "last_loop_m": last_loop_error_m(truth, poses)}


def last_loop_error_m(truth: np.ndarray, poses: np.ndarray) -> float:
    """How wrong poses ``(n, 3)`` are at the last loop: against where the robot was before, at the same place.

    A visit is a scan, one each half a metre, within 1 m of an earlier one with more than 50 m of way between. Its error
    is that of its position seen from the first such scan. The median of the last ten visits counts; without any, NaN.
    """
    way_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T)))
    used = np.unique(np.searchsorted(way_m, np.arange(0.0, way_m[-1], _EVERY_M)))
    near = KDTree(truth[used, :2]).query_ball_point(truth[used, :2], _SAME_PLACE_M)
    first = used[[min(indices) for indices in near]]
    visits = np.flatnonzero(way_m[used] - way_m[first] > _LOOP_WAY_M)[-_LAST_VISITS:]
    if not len(visits):
        return float("nan")
    a, b = first[visits], used[visits]
    off = all_between(poses[a], poses[b]) - all_between(truth[a], truth[b])
    return float(np.median(np.hypot(off[:, 0], off[:, 1])))


def visit_facts(drive: LidarDrive, poses: np.ndarray) -> dict[str, float]:
    """``second_visit`` of the scans as they were measured."""
    found = second_visit([scan_points(scan, drive.mounting) for scan in drive.scans], poses)
    return {f"second_visit_{key}": value for key, value in dataclasses.asdict(found).items()}


def join_row() -> Row:
    """Our whole pipeline, how many of its loops are wrong, and whether the robot is lost in the end."""
    pipeline = Pipeline()
    return Row(partial(_ours_with_joins, pipeline=pipeline), pipeline, code=(mixture_lidar, scan_trajectory))


def _ours_with_joins(runs: DriveRuns, pipeline: Pipeline) -> Estimate:
    found, run = ours(runs, pipeline), runs.run(pipeline)
    back_end, truth = run.online.back_end, _truth(runs.drive)
    rows = np.searchsorted(truth.stamps_ns, run.trajectory.stamps_ns[back_end.closed.pairs])
    wrong = wrong_joins(truth.poses_xyyaw, rows, back_end.closed.relative)
    facts = {
        "wrong_loops": wrong.sum(),
        "wrong_believed": (wrong & (back_end.closed.weight > BELIEVED)).sum(),
        "lost_at_end": float(back_end.lost_since is not None),
    }
    return dataclasses.replace(found, facts={**found.facts, **facts})


def wrong_joins(truth: np.ndarray, pairs: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Which loops ``(loops, 2)``, as rows of the truth, measured something ``(loops, 3)`` that is not so, bool.

    A loop is wrong by more than 0.5 m or 5 deg, as a claim of where a robot is.
    """
    off = relative - all_between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    turn_deg = np.degrees(np.abs(np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi))
    return np.asarray((np.hypot(off[:, 0], off[:, 1]) > MOST_M) | (turn_deg > MOST_DEG))


def _truth(drive: LidarDrive) -> TruePoses:
    if not isinstance(drive.reference, TruePoses):
        raise ValueError(f"{drive.name} has no truth; expected a simulated drive")
    return drive.reference
