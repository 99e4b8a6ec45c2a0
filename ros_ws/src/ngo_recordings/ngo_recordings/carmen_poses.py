"""What the poses in a CARMEN log are: raw wheel odometry, the laser's place on the robot, or a mapper's corrections.

A line of a scan has two poses, of the laser and of the robot. Which of them is the odometry depends on who wrote the
log (see `interpret`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

_SAME_M = 1e-6
_RIGID_M, _RIGID_RAD = 0.02, 0.02
# ODOM lines this far from the poses of the scans, in the median, are another track.
_APART_M = 0.5
# Odometry that covers less than this share of a step that a mapper saw stands still there.
_STILL_SHARE, _STEP_M = 0.1, 0.1


@dataclass(frozen=True)
class LogPoses:
    """Poses by line ``(lines, 3)`` as x, y (m), yaw (rad); NaN where a line has none.

    odometry: raw wheels. corrected: of a mapper, at scans. mounting ``(3,)``: the laser on the robot; None: the log
    does not say it. speeds_known: the velocities in ODOM lines are the robot's. notes: what a person should know.
    """

    odometry: np.ndarray
    corrected: np.ndarray
    mounting: np.ndarray | None
    speeds_known: bool
    notes: tuple[str, ...]


def interpret(is_scan: np.ndarray, first: np.ndarray, second: np.ndarray, gmapping: bool) -> LogPoses:
    """Sort the poses of a log's lines in order.

    - Written by GMapping: the poses of scans are its own, and ODOM lines go on from them. Raw odometry is the chain of
      the motions from each scan's pose to the last ODOM line before the next scan.
    - The two poses differ by the same step everywhere: the step is the mounting, the second pose the odometry.
    - The two poses differ otherwise: the first is corrected, the second the odometry.
    - They are the same: they are the odometry, unless ODOM lines follow another track; then those are the odometry and
      the poses of the scans corrected.

    Args:
        is_scan: ``(lines,)`` bool; the others are ODOM lines.
        first, second: ``(lines, 3)``: poses of laser and robot of a scan; NaN where it has none. An ODOM line has its
            pose in both.
        gmapping: the log has marks that only GMapping writes.
    """
    nothing = np.full_like(first, np.nan)
    posed = is_scan & np.isfinite(first).all(axis=1)
    if not posed.any():
        return LogPoses(np.where(is_scan[:, None], np.nan, second), nothing, None, True, ())
    at_scans = np.where(posed[:, None], first, np.nan)
    if gmapping:
        return _of_gmapping(is_scan, posed, first, at_scans)
    steps = _between(second[posed], first[posed])
    if np.abs(steps).max() > _SAME_M:
        # Against the first one, so that a laser that looks back has no seam at pi.
        steps[:, 2] = steps[0, 2] + _wrapped(steps[:, 2] - steps[0, 2])
        middle = np.median(steps, axis=0)
        away = np.abs(steps - middle)
        if away[:, :2].max() < _RIGID_M and away[:, 2].max() < _RIGID_RAD:
            return LogPoses(second, nothing, middle, True, ())
        note = "the first poses of the scans are a mapper's (/corrected_pose), the second ones the wheel odometry"
        return LogPoses(second, at_scans, None, True, (note,))
    if _median_jump(is_scan, posed, first) > _APART_M:
        note = "the poses of the scans are not the ODOM lines': they are taken for a mapper's (/corrected_pose)"
        return LogPoses(np.where(is_scan[:, None], np.nan, second), at_scans, np.zeros(3), True, (note,))
    return LogPoses(second, nothing, np.zeros(3), True, ())


def _of_gmapping(is_scan: np.ndarray, posed: np.ndarray, poses: np.ndarray, at_scans: np.ndarray) -> LogPoses:
    raw = _rechained(is_scan, posed, poses)
    note = "GMapping wrote the log: poses of the scans are its own (/corrected_pose), odometry is chained between them"
    moved, covered = (np.hypot(*np.diff(track[posed, :2], axis=0).T) for track in (raw, poses))
    steps = covered > _STEP_M
    still = steps & (moved < _STILL_SHARE * covered)
    if still.sum() > 0.5 * steps.sum():
        gone = f"the log has no wheel odometry: it stands still in {still.sum()} of {steps.sum()} steps between scans"
        return LogPoses(np.full_like(raw, np.nan), at_scans, np.zeros(3), False, (note, gone))
    return LogPoses(raw, at_scans, np.zeros(3), False, (note,))


def _rechained(is_scan: np.ndarray, posed: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Raw odometry of a log whose ODOM lines begin anew at every scan's pose."""
    raw = np.full_like(poses, np.nan)
    base = start = last = (0.0, 0.0, 0.0)
    after_scan = False
    for index, (x, y, yaw) in enumerate(poses.tolist()):
        if posed[index]:
            base, start, after_scan = last, (x, y, yaw), True
        elif not is_scan[index]:
            repeats, after_scan = after_scan and (x, y, yaw) == start, False
            if repeats:  # GMapping repeats the scan's pose, with a stamp from nowhere
                continue
            back = base[2] - start[2]
            c, s = math.cos(back), math.sin(back)
            dx, dy = x - start[0], y - start[1]
            turned = math.remainder(back + yaw, 2.0 * math.pi)
            last = (base[0] + c * dx - s * dy, base[1] + s * dx + c * dy, turned)
        else:
            continue
        raw[index] = last
    return raw


def _median_jump(is_scan: np.ndarray, posed: np.ndarray, poses: np.ndarray) -> float:
    """Median distance of scans to the last ODOM line before them, m; 0 where there are none."""
    lines = np.flatnonzero(~is_scan)
    scans = np.flatnonzero(posed)
    before = np.searchsorted(lines, scans) - 1
    scans, before = scans[before >= 0], before[before >= 0]
    if not len(scans):
        return 0.0
    return float(np.median(np.hypot(*(poses[scans, :2] - poses[lines[before], :2]).T)))


def _between(origins: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Each pose in its origin's frame ``(n, 3)``."""
    c, s = np.cos(origins[:, 2]), np.sin(origins[:, 2])
    dx, dy = (poses[:, :2] - origins[:, :2]).T
    return np.stack((c * dx + s * dy, c * dy - s * dx, _wrapped(poses[:, 2] - origins[:, 2])), axis=1)


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.asarray(np.remainder(angles + math.pi, 2.0 * math.pi) - math.pi)
