"""The online trajectory of a 2D lidar: relative poses and key scans in, the whole corrected trajectory out (no ROS)."""

from pathlib import Path

import numpy as np
import torch

from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.data.relative_step import RelativeStep, check_step
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.geometry import se2
from ngo_estimator.online.online_trajectory import Trajectory, TrajectoryUpdate
from ngo_estimator.online.scan_graph import ScanGraph, ScanGraphConfig
from ngo_estimator.online.step_log import StepLog

_VARIANCES = (1e-12, 1e4)


class ScanTrajectory:
    """Keeps the trajectory of a lidar and corrects it whenever loops call for it.

    Between two key scans the newest frames follow the last one by odometry. A robot that stands adds frames, and no key
    scans.
    """

    def __init__(self, config: ScanGraphConfig | None = None, iterations_per_step: int = 0) -> None:
        if iterations_per_step < 0:
            raise ValueError(f"iterations_per_step is {iterations_per_step}; expected 0 (all at once) or more")
        self._config = config or ScanGraphConfig()
        self._iterations_per_step = iterations_per_step or self._config.iterations
        self._log = StepLog()
        self.reset()

    @classmethod
    def load(cls, weights: Path, world: str | None = None, iterations_per_step: int = 0) -> "ScanTrajectory":
        """Begin with the settings in the folder ``weights``; raises ``LidarFileError``, of one clear line."""
        return cls(read_lidar_file(weights, "graph", ScanGraphConfig, world), iterations_per_step)

    def reset(self) -> None:
        """Forget everything: the next step begins a new trajectory."""
        self._log.reset()
        self._begin()

    def _begin(self) -> None:
        self._online = GrowingRows((3,), np.float64)
        self._graph = ScanGraph(self._config)
        self._optimized = False
        self._odom = np.zeros(3)  # of the newest frame, on TF

    def update(self, step: RelativeStep, optimize: bool = True) -> TrajectoryUpdate:
        """Take the next step; see ``StepLog.take`` for gaps and new beginnings.

        Raises:
            RejectedStep: values that are not finite, too large or of the wrong shape, a stamp that came already, or one
                that is a little late. The trajectory is as it was before.
        """
        check_step(step, 0, None)
        taken = self._log.take(step)
        if taken.begins:
            self._begin()
            self._graph.begin_at(step)
            self._online.append(np.zeros(3))
        due = self._graph.append(taken.relative, _bounded(taken.covariance), step.key)
        self._odom = step.tf_odom_xyyaw
        self._optimized = False
        if not optimize:
            self._graph.abandon()
        elif due:
            self._graph.begin()
        if self._graph.running:
            self._optimized = self._graph.advance(self._iterations_per_step)
        update = self._result(taken.restarted, taken.gap)
        self._online.append(update.pose_xyyaw)
        return update

    @property
    def graph(self) -> ScanGraph:
        """The graph of key scans."""
        return self._graph

    @property
    def unfinished(self) -> bool:
        """Whether loops wait for an optimisation, which later steps, or ``finish``, are to run."""
        return self._graph.running or self._graph.waiting

    @property
    def optimization_s(self) -> float:
        """Computing time of the last optimisation."""
        return self._graph.took_s

    def finish(self) -> TrajectoryUpdate | None:
        """Optimise until nothing moves any more, when no more steps come; None where there is nothing to do."""
        if self._log.steps == 0 or not self._graph.finish():
            return None
        self._optimized = True
        return self._result(restarted=False, gap=False)

    def trajectory(self) -> Trajectory | None:
        """The whole trajectory as it is now, or None before the first step."""
        if self._log.steps == 0:
            return None
        graph, log = self._graph, self._log
        poses, moved = graph.frame_poses(), np.zeros(log.steps + 1)
        if self._optimized:
            before = graph.frame_poses(before=True)
            moved[:-1] = np.linalg.norm((poses - before)[:-1, :2], axis=1)
        arrays = (
            log.stamps_ns.values, poses, log.odometry.values, self._online.values, moved, log.odometry_std.values,
            graph.loop_frames, graph.loop_weights, graph.loop_relative, graph.loop_std,
        )  # fmt: skip
        return Trajectory(*map(_read_only, arrays))

    def walls(self, most: int) -> np.ndarray:
        """Points ``(n, 2)`` of all key scans at their corrected poses, thinned to about ``most``."""
        return self._graph.walls(most)

    def _result(self, restarted: bool, gap: bool) -> TrajectoryUpdate:
        pose, covariance = self._graph.newest()
        map_from_odom = se2.compose(torch.from_numpy(pose), se2.inverse(torch.from_numpy(self._odom))).numpy()
        return TrajectoryUpdate(
            stamp_ns=int(self._log.stamps_ns.values[-1]),
            pose_xyyaw=_read_only(pose),
            covariance=_read_only(covariance),
            map_from_odom_xyyaw=_read_only(map_from_odom),
            frames=len(self._log.stamps_ns),
            optimized=self._optimized,
            restarted=restarted,
            gap=gap,
            largest_move_m=self._graph.largest_move_m if self._optimized else 0.0,
            closed_loops=int((self._graph.loop_weights > 0.5).sum()),
            window_fill=0.0,
        )


def _bounded(covariance: np.ndarray) -> np.ndarray:
    """The covariance with eigenvalues between those that are as good as exact and unknown."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    bounded: np.ndarray = (vectors * np.clip(values, *_VARIANCES)) @ vectors.T
    return bounded


def _read_only(values: np.ndarray) -> np.ndarray:
    copy: np.ndarray = np.array(values)
    copy.flags.writeable = False
    return copy
