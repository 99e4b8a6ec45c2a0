"""Several robots in one building: each mapped alone, and all of them together."""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.slam.fleet import Fleet
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.session_union import united
from training.data.lidar_drives import LidarDrive, TruePoses
from training.scoring.lidar_rows import DriveRuns, Pipeline
from training.scoring.metrics import absolute_error_m, position_rmse_m, rigid_motion
from training.scoring.table import Measured

SHARED_M = 10.0
"""A way that two robots have in common: from then on they should meet."""

IN_TIME = 100
"""Scans within which they should."""

_NEAR_M = 1.0
"""A robot sees what another one saw where it is that near to the other one's way."""

_FALSE_M, _LEAST_SPREAD_M = 2.0, 2.0
"""A meeting is false where a robot is that far from where it should be beside the other's way, which extends so far."""


_MOST_WALL_POINTS = 40_000  # of a picture


class FleetRuns:
    """The drives of all robots in a building, and what their odometries give."""

    def __init__(self, drives: Sequence[LidarDrive], weights: Path) -> None:
        self._runs = [DriveRuns(drive, weights) for drive in drives]
        self._graph = read_lidar_file(weights, "graph", ScanGraphConfig)
        self.names = [f"r{number}" for number in range(1, len(drives) + 1)]

    def alone(self) -> Measured:
        """The mean error of the robots, each mapped alone."""
        errors = []
        for robot in range(len(self._runs)):
            trajectory = self._runs[robot].run(Pipeline()).trajectory
            errors.append(absolute_error_m(trajectory.poses_xyyaw, self.truth(robot, trajectory.stamps_ns)))
        return Measured.of({"ate_m": float(np.mean(errors))})

    @property
    def odometry_s(self) -> float:
        """Computing time of the odometries of all robots."""
        return sum(runs.run(Pipeline()).front.took_s for runs in self._runs)

    def truth(self, robot: int, stamps_ns: np.ndarray) -> np.ndarray:
        """True poses ``(n, 3)`` of a robot at stamps of its scans ``(n,)``."""
        reference = self._runs[robot].drive.reference
        assert isinstance(reference, TruePoses)
        return np.asarray(reference.poses_xyyaw[np.searchsorted(reference.stamps_ns, stamps_ns)])

    def scans_late(self, robot: int, met_ns: int | None) -> float | None:
        """Scans of a robot from when it had ``SHARED_M`` of its way in common with the first one's until they met.

        Infinite if they did not; None if they never had.
        """
        first, other = (self._runs[number].drive.reference for number in (0, robot))
        assert isinstance(first, TruePoses) and isinstance(other, TruePoses)
        shared_ns = _shared_since_ns(first, other)
        if shared_ns is None:
            return None
        if met_ns is None:
            return math.inf
        return float(np.count_nonzero((other.stamps_ns > shared_ns) & (other.stamps_ns <= met_ns)))

    def steps(self) -> Iterator[tuple[int, RelativeStep]]:
        """The steps of all robots, each with its robot's number, in the order of their stamps."""
        streams = [
            [(step.stamp_ns, robot, number) for number, step in enumerate(runs.run(Pipeline()).front.steps)]
            for robot, runs in enumerate(self._runs)
        ]
        for _, robot, number in heapq.merge(*streams):
            yield robot, self._runs[robot].run(Pipeline()).front.steps[number]

    def together(self) -> Measured:
        """All robots in one map.

        ``ate_m``: the mean error of the robots, each aligned by itself; ``joint_ate_m`` of those in the map of all,
        aligned as one. ``met``: the share of the other robots that were in the map of the first at the end.
        ``in_time``: of those that had 10 m in common with the first one, the share that was there within 100 scans
        after that; ``scans_to_meeting`` of those that were there. ``false_meetings``: whether two robots in one map
        ever were elsewhere than it says. ``ms_a_step``: computing time of a step, without the odometry.
        """
        fleet, seen, took_s = Fleet(ScanTrajectory(self._graph), self.names), _Meetings(self), 0.0
        for robot, step in self.steps():
            began = time.process_time()
            update = fleet.update(self.names[robot], step)
            fleet.correct()
            took_s += time.process_time() - began
            seen.take(robot, step.stamp_ns, update.update.pose_xyyaw, update.map_of)
        fleet.finish()
        errors, joint, true, drawn = [], [], [], {}
        for robot, name in enumerate(self.names):
            trajectory = fleet.trajectory(name)
            assert trajectory is not None
            truth = self.truth(robot, trajectory.stamps_ns)
            errors.append(absolute_error_m(trajectory.poses_xyyaw, truth))
            if fleet.map_of(name) is None:
                joint.append(trajectory.poses_xyyaw)
                true.append(truth)
                drawn[f"way_{name}"] = trajectory.poses_xyyaw
        found = {"ate_m": float(np.mean(errors)), "false_meetings": float(seen.false), "met": seen.met()}
        found["joint_ate_m"] = absolute_error_m(np.concatenate(joint), np.concatenate(true))
        found["ms_a_step"] = 1e3 * took_s / max(1, seen.steps)
        drawn["walls"] = fleet.walls(self.names[0], _MOST_WALL_POINTS)
        return Measured({**Measured.of(found).errors, **seen.delays()}, drawn)

    def joined(self) -> Measured:
        """Each robot maps alone and saves its state; then all are laid into the map of the first.

        ``ate_m``, ``joint_ate_m`` and ``met`` are as of ``together``. ``false_meetings``: whether the map has a robot
        elsewhere than it was. ``s_to_join``: computing time of the union.
        """
        cores = [self._mapped(robot) for robot in range(len(self._runs))]
        began = time.process_time()
        union = united(cores)
        found = {"s_to_join": time.process_time() - began}
        placed, errors, seen = union.trajectory.trajectory(), [], []
        assert placed is not None
        for robot, (core, later_ns) in enumerate(zip(cores, union.later_ns, strict=True)):
            own = core.trajectory()
            assert own is not None
            poses, truth = own.poses_xyyaw, self.truth(robot, own.stamps_ns)
            if robot not in union.left_out:
                poses = placed.poses_xyyaw[np.searchsorted(placed.stamps_ns, own.stamps_ns + later_ns)]
                seen.append((poses, truth))
            errors.append(absolute_error_m(poses, truth))
        fits = rigid_motion(seen[0][1][:, :2], seen[0][0][:, :2])
        off_m = [position_rmse_m(poses, se2.compose(fits, truth)) for poses, truth in seen]
        found |= {"ate_m": float(np.mean(errors)), "false_meetings": float(max(off_m) > _FALSE_M)}
        found["met"] = (len(seen) - 1) / (len(cores) - 1)
        found["joint_ate_m"] = absolute_error_m(*(np.concatenate(column) for column in zip(*seen, strict=True)))
        return Measured.of(found)

    def _mapped(self, robot: int) -> ScanTrajectory:
        """The map of a robot alone."""
        core = ScanTrajectory(self._graph)
        for step in self._runs[robot].run(Pipeline()).front.steps:
            core.update(step)
            core.correct()
        core.finish()
        return core


class _Seen:
    """Of a robot in one map: where it is said to be, where it is, and the motion from the one to the other so far."""

    def __init__(self, map_of: str | None) -> None:
        self.map_of, self.count = map_of, 0
        self._sums = np.zeros(4, np.complex128)  # of said and true positions, their product, and of squares

    def take(self, said: np.ndarray, true: np.ndarray) -> None:
        """Take the newest positions ``(2,)``."""
        self.said, self.true = complex(*said[:2]), complex(*true[:2])
        self._sums += self.said, self.true, self.said.conjugate() * self.true, abs(self.said) ** 2
        self.count += 1

    def spread_m(self) -> float:
        """Root mean square distance of what was said from its mean."""
        return math.sqrt(max(0.0, (self._sums[3] / self.count).real - abs(self._sums[0] / self.count) ** 2))

    def off_m(self, other: _Seen) -> float:
        """How far another robot is from where the map has it, after the motion that fits this one's way best."""
        said, true, product = self._sums[:3] / self.count
        turn = product - said.conjugate() * true
        return abs(true + turn / abs(turn) * (other.said - said) - other.true)


class _Meetings:
    """When robots came into the map of the first, and whether they are where it says."""

    def __init__(self, runs: FleetRuns) -> None:
        self._runs = runs
        self._newest: dict[int, _Seen] = {}
        self._met_ns: dict[int, int] = {}
        self.false, self.steps = False, 0

    def take(self, robot: int, stamp_ns: int, pose: np.ndarray, map_of: str | None) -> None:
        """Take what is said of a robot after a step."""
        self.steps += 1
        seen = self._newest.get(robot)
        if seen is None or seen.map_of != map_of:
            seen = self._newest[robot] = _Seen(map_of)
        seen.take(pose, self._runs.truth(robot, np.array((stamp_ns,)))[0])
        if map_of is None:
            self._met_ns.setdefault(robot, stamp_ns)
        for other, its in self._newest.items():
            if other != robot and its.map_of == map_of:
                longer, shorter = (its, seen) if its.spread_m() > seen.spread_m() else (seen, its)
                self.false |= longer.spread_m() > _LEAST_SPREAD_M and longer.off_m(shorter) > _FALSE_M

    def met(self) -> float:
        """The share of the robots but the first that are in its map now."""
        return float(np.mean([its.map_of is None for robot, its in self._newest.items() if robot]))

    def delays(self) -> dict[str, np.ndarray]:
        """``in_time`` and ``scans_to_meeting`` of the robots that had a way in common with the first."""
        late, in_time = [], []
        for robot in range(1, len(self._runs.names)):
            scans = self._runs.scans_late(robot, self._met_ns.get(robot))
            if scans is None:
                continue
            in_time.append(float(scans <= IN_TIME))
            late += [scans] if scans < math.inf else []
        return {"in_time": np.array(in_time), "scans_to_meeting": np.array(late)}


def _shared_since_ns(first: TruePoses, other: TruePoses) -> int | None:
    """When one of two robots had so much of its way in common with what the other had driven by then; None if never."""
    since = [_common_since_ns(*pair) for pair in ((first, other), (other, first))]
    known = [stamp_ns for stamp_ns in since if stamp_ns is not None]
    return min(known) if known else None


def _common_since_ns(one: TruePoses, other: TruePoses) -> int | None:
    at = one.poses_xyyaw[:, :2]
    near = KDTree(other.poses_xyyaw[:, :2]).query_ball_point(at, _NEAR_M)
    never = np.iinfo(np.int64).max
    seen_ns = np.array([other.stamps_ns[min(rows)] if rows else never for rows in near])
    common_ns = np.maximum(one.stamps_ns, seen_ns)
    lengths = np.concatenate(((0.0,), np.linalg.norm(np.diff(at, axis=0), axis=1)))
    order = np.argsort(common_ns, kind="stable")
    enough = np.flatnonzero((lengths[order].cumsum() >= SHARED_M) & (common_ns[order] < never))
    return int(common_ns[order[enough[0]]]) if len(enough) else None
