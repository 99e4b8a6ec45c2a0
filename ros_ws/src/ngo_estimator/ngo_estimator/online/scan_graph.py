"""The graph of key scans behind the online trajectory of a lidar: nodes by motion, verified loops, warm starts.

Node ``k`` is the pose of key scan ``k``; node 0, the first frame, is the origin of ``map``. A robot that stands adds no
node. Frames between two nodes follow them by odometry.
"""

import math
import time
from dataclasses import dataclass, field

import numpy as np
import torch

from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_scan import KeyScan, no_scan
from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.geometry.planar_motion import transformed
from ngo_estimator.optimizer.scan_loop_candidates import WindowConfig, distance_windows, graph_distances
from ngo_estimator.optimizer.scan_loops import ScanLoopConfig, ScanLoopFinder
from ngo_estimator.optimizer.scan_pose_graph import RelativePoses, ScanPoseGraph

_MOST_ITERATIONS = 30
"""Until nothing moves any more, at the end of a recording."""


@dataclass(frozen=True)
class ScanGraphConfig:
    """How key scans are optimised.

    An optimisation takes ``iterations`` at most, and begins once ``keys_between`` key scans came since the last one, or
    at once where a new loop is ``surprise`` deviations off the graph. The Cauchy kernel on steps and loops is
    ``kernel`` deviations wide. ``step_m`` and ``step_deg`` are deviations that are added to
    each step's covariance: registration in the same few key scans does not see them.
    """

    loops: ScanLoopConfig = field(default_factory=ScanLoopConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    iterations: int = 5
    keys_between: int = 8
    surprise: float = 3.0
    kernel: float = 3.0
    step_m: float = 0.005
    step_deg: float = 0.15

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.keys_between < 1:
            raise ValueError(
                f"iterations, keys_between are {self.iterations}, {self.keys_between}; expected at least 1 of each"
            )
        positive = (self.surprise, self.kernel, self.step_m, self.step_deg)
        if not all(0.0 < value < math.inf for value in positive):
            raise ValueError(f"surprise, kernel, step_m, step_deg are {positive}; expected positive numbers")


class ScanGraph:
    """Takes frames, keeps key scans and their loops, and optimises all of them together."""

    def __init__(self, config: ScanGraphConfig) -> None:
        self.config = config
        self.odometry = GrowingRows((3,), np.float64)
        """Poses of all frames by the relative poses alone, the first at the origin."""
        self.odometry.append(np.zeros(3))
        self._frames = GrowingRows((), np.int64)  # of the nodes
        self._nodes = GrowingRows((3,), np.float64)
        self._steps = GrowingRows((3,), np.float64)
        self._step_covariance = GrowingRows((3, 3), np.float64)
        self._scans: list[KeyScan] = []
        self._key_stamp_ns = 0
        self._finder = ScanLoopFinder(config.loops)
        self._since = np.zeros((3, 3))  # covariance of the newest frame, seen from the last node
        self._end = np.zeros((3, 3))  # covariance of the last node in the map
        self._running: ScanPoseGraph | None = None
        self._rows = np.zeros(0, np.int64)
        self._left = 0
        self._waiting = 0  # keys since the last optimisation, where there is a loop that it has not seen
        self._before = np.zeros((1, 3))
        self._loop_rows = np.zeros(0, np.int64)  # of the last optimisation, among all that were verified
        self.loop_weights = np.zeros(0)
        """Of the loops in the last optimisation ``(loops,)``, zero to one."""
        self.took_s = 0.0
        """Computing time of the last optimisation."""

    @property
    def keys(self) -> int:
        """Key scans so far."""
        return len(self._nodes)

    @property
    def running(self) -> bool:
        """Whether an optimisation has begun that is not done."""
        return self._running is not None

    @property
    def largest_move_m(self) -> float:
        """How far the last optimisation moved a node at most."""
        moved = self._nodes.values[: len(self._before), :2] - self._before[:, :2]
        return float(np.hypot(moved[:, 0], moved[:, 1]).max(initial=0.0))

    def begin_at(self, step: RelativeStep) -> None:
        """Take the first frame, before the first step. No loop leads to it where its scan is missing."""
        self._scans.append(no_scan(step.from_stamp_ns) if step.origin_scan is None else step.origin_scan)
        self._frames.append(0)
        self._nodes.append(np.zeros(3))
        self._key_stamp_ns = step.from_stamp_ns

    def append(self, relative: np.ndarray, covariance: np.ndarray, key: KeyScanStep | None) -> bool:
        """Take a step ``(3,)`` with its covariance ``(3, 3)``; returns whether it is time to optimise."""
        last = torch.from_numpy(self.odometry.values[-1])
        self.odometry.append(se2.compose(last, torch.from_numpy(relative.astype(np.float64))).numpy())
        since = self._since_key()
        self._since = propagate(self._since, since, relative, covariance)
        if key is None:
            return False
        if self._running is not None:
            self.advance(self._left)  # what comes now adds a node to those that it is about
        known = key.from_key_stamp_ns == self._key_stamp_ns
        # Registration in the same key scans: errors of the steps between do not add up.
        self._complete(key, since, key.covariance if known else self._since)
        return self._look_for_loops()

    def _since_key(self) -> np.ndarray:
        """Pose ``(3,)`` of the newest frame, seen from the last node."""
        ends = torch.from_numpy(self.odometry.values[[int(self._frames.values[-1]), -1]])
        since: np.ndarray = se2.between(ends[0], ends[1]).numpy()
        return since

    def _complete(self, key: KeyScanStep, since: np.ndarray, covariance: np.ndarray) -> None:
        config = self.config
        floor = np.diag((config.step_m**2, config.step_m**2, math.radians(config.step_deg) ** 2))
        self._steps.append(since)
        self._step_covariance.append(covariance + floor)
        pose = se2.compose(torch.from_numpy(self._nodes.values[-1]), torch.from_numpy(since)).numpy()
        self._end = propagate(self._end, pose, since, covariance + floor)
        self._nodes.append(pose)
        self._frames.append(len(self.odometry) - 1)
        self._scans.append(key.scan)
        self._key_stamp_ns = key.scan.stamp_ns
        self._since = np.zeros((3, 3))

    def _look_for_loops(self) -> bool:
        """Ask for loops of the newest key; returns whether an optimisation is due."""
        poses, config = self._nodes.values, self.config
        accepted = self._finder.loops.pairs[self._finder.loops.accepted]
        if (self.keys - 1) % config.loops.every:
            found = 0.0
        else:
            windows = distance_windows(config.windows, graph_distances(poses, accepted, self.keys - 1))
            loops = self._finder.find(self._scans, poses, windows)
            off = RelativePoses.of_covariances(loops.pairs, loops.relative, loops.covariance).residuals(poses)
            found = float(np.sqrt((off**2).sum(1)).max(initial=0.0))
            self._waiting = max(self._waiting, int(len(loops) > 0))
        self._waiting += self._waiting > 0
        return self._waiting > config.keys_between or found > config.surprise

    def measurements(self) -> tuple[RelativePoses, RelativePoses]:
        """The steps from each node to the next, and the accepted loops."""
        loops = self._finder.loops[np.flatnonzero(self._finder.loops.accepted)]
        chain = np.arange(self.keys - 1)
        steps = RelativePoses.of_covariances(
            np.stack((chain, chain + 1), axis=1), self._steps.values, self._step_covariance.values
        )
        return steps, RelativePoses.of_covariances(loops.pairs, loops.relative, loops.covariance)

    def begin(self) -> None:
        """Begin to optimise all nodes."""
        began = time.perf_counter()
        self._rows = np.flatnonzero(self._finder.loops.accepted)
        steps, measured = self.measurements()
        gates = np.ones(len(self._rows))
        self._running = ScanPoseGraph(steps, measured, gates, self._nodes.values, self.config.kernel)
        self._left = self.config.iterations
        self._waiting = 0
        self.took_s = time.perf_counter() - began

    def advance(self, iterations: int) -> bool:
        """Run so many iterations of what has begun; returns whether it is done, and every node at its new pose."""
        running = self._running
        if running is None:
            raise RuntimeError("no optimisation has begun")
        began = time.perf_counter()
        for _ in range(min(iterations, self._left)):
            running.iterate()
            self._left = 0 if running.converged else self._left - 1
        self.took_s += time.perf_counter() - began
        if self._left:
            return False
        self._running = None
        self._before = self._nodes.values.copy()
        self._nodes.values[:] = running.poses
        self._loop_rows, self.loop_weights = self._rows, running.weights
        if running.equations is not None:
            self._end = running.equations.covariance([self.keys - 1])
        return True

    def abandon(self) -> None:
        """Leave undone what has begun."""
        if self._running is not None:
            self._running, self._waiting = None, self.config.keys_between

    @property
    def waiting(self) -> bool:
        """Whether there is a loop that no optimisation has seen."""
        return self._waiting > 0

    def finish(self) -> bool:
        """Optimise until nothing moves any more; returns whether there was anything to optimise."""
        if self._running is None:
            if not self._finder.loops.accepted.any():
                return False
            self.begin()
        self._left = _MOST_ITERATIONS
        return self.advance(self._left)

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame, behind the last node by odometry, and its covariance ``(3, 3)``."""
        since = self._since_key()
        pose = se2.compose(torch.from_numpy(self._nodes.values[-1]), torch.from_numpy(since)).numpy()
        return pose, propagate(self._end, pose, since, self._since)

    def frame_poses(self, before: bool = False, nodes: np.ndarray | None = None) -> np.ndarray:
        """Poses of all frames ``(frames, 3)``, as they are or as they were before the last optimisation.

        The difference between two nodes and their odometry is spread evenly over the frames between. With ``nodes``
        ``(nodes, 3)`` these are the poses of the nodes.
        """
        nodes = (self._nodes.values if nodes is None else nodes).copy()
        if before:
            nodes[: len(self._before)] = self._before
        odometry, at = torch.from_numpy(self.odometry.values), self._frames.values
        starts, ends = torch.from_numpy(nodes), odometry[torch.from_numpy(at)]
        segment = torch.from_numpy(np.searchsorted(at, np.arange(len(odometry)), side="right") - 1)
        within = se2.between(ends[segment], odometry)
        bent = torch.zeros_like(starts)
        bent[:-1] = se2.between(starts[:-1], starts[1:]) - se2.between(ends[:-1], ends[1:])
        bent[:, 2] = se2.wrap(bent[:, 2])
        first = torch.from_numpy(at)[segment]
        length = torch.ones(len(nodes), dtype=torch.float64)
        length[:-1] = torch.from_numpy(np.diff(at).astype(np.float64))
        share = (torch.arange(len(odometry), dtype=torch.float64) - first) / length[segment]
        poses: np.ndarray = se2.compose(starts[segment], within + share.unsqueeze(-1) * bent[segment]).numpy()
        return poses

    def walls(self, most: int) -> np.ndarray:
        """Points ``(n, 2)`` of all key scans in the map, thinned to about ``most``."""
        total = sum(len(scan.points) for scan in self._scans)
        every = max(1, -(-total // most))
        parts = [
            transformed(pose, scan.points[::every]) for pose, scan in zip(self._nodes.values, self._scans, strict=True)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 2))

    @property
    def loop_frames(self) -> np.ndarray:
        """Frames ``(loops, 2)`` that the loops of the last optimisation join."""
        frames: np.ndarray = self._frames.values[self._finder.loops.pairs[self._loop_rows]]
        return frames

    @property
    def loop_relative(self) -> np.ndarray:
        """What these loops measured ``(loops, 3)``."""
        return self._finder.loops.relative[self._loop_rows]

    @property
    def loop_std(self) -> np.ndarray:
        """Deviations ``(loops, 3)`` of what they measured, in which their weights are accounted for."""
        variance = np.diagonal(self._finder.loops.covariance, axis1=1, axis2=2)[self._loop_rows]
        return np.sqrt(variance / np.maximum(self.loop_weights, 1e-12)[:, None])
