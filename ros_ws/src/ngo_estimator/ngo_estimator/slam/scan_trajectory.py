"""The online trajectory of a 2D lidar: relative poses and key scans in, the whole corrected trajectory out (no ROS)."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.data.relative_step import KeyScanStep, RejectedStep, RelativeStep
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.graph.pose_graph import OPEN
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.scan_back_end import ScanBackEnd
from ngo_estimator.slam.step_log import StepLog
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate
from ngo_estimator.trajectory.g2o import PlanarGraph, graph_of


class ScanTrajectory(CorrectedTrajectory):
    """Keeps the trajectory of a lidar and corrects it whenever loops call for it.

    Between two key scans the newest frames follow the last one by odometry. A robot that stands adds frames, and no key
    scans.
    """

    _back_end: ScanBackEnd

    def __init__(self, config: ScanGraphConfig | None = None, iterations_per_step: int = 0) -> None:
        if iterations_per_step < 0:
            raise ValueError(f"iterations_per_step is {iterations_per_step}; expected 0 (before the answer) or more")
        self._config = config or ScanGraphConfig()
        super().__init__(answers_first=iterations_per_step > 0)

    @classmethod
    def load(cls, weights: Path, world: str | None = None, iterations_per_step: int = 0) -> "ScanTrajectory":
        """Begin with the settings in the folder ``weights``; raises ``LidarFileError``, of one clear line."""
        return cls(read_lidar_file(weights, "graph", ScanGraphConfig, world), iterations_per_step)

    @property
    def back_end(self) -> ScanBackEnd:
        """The graph of key scans, and its loops."""
        return self._back_end

    @property
    def log(self) -> StepLog:
        """The stamps and the odometry of all frames."""
        return self._log

    def join(self, step: RelativeStep, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> TrajectoryUpdate:
        """See ``CorrectedTrajectory.join``. The frames before that are no key scans leave: one drive after the other
        in one place would add frames for ever.
        """
        if self.may_join(self._back_end.checked(step)):
            self.check_later(step)
            self._work()
            kept = self._back_end.keep_nodes()
            self._log.keep(kept)
            self._online.set(self._online.values[kept])
        return super().join(step, pose_xyyaw, covariance)

    def begin_segment(self, step: RelativeStep) -> TrajectoryUpdate:
        """Go on with another odometry, from the frame that ``step`` ends at; nobody knows where that is in the map.

        Raises:
            RejectedStep: as of ``update``; the stamp is not later than the newest one, or the step has no key scan.
        """
        return self._join_at(replace(self._back_end.checked(step), segment=True), np.zeros(3), OPEN)

    def begin_stream(
        self, step: RelativeStep, rank: int, ends: bool = False, optimize: bool = True
    ) -> TrajectoryUpdate:
        """Take the first step of another odometry, which goes on beside those before; nobody knows where it is.

        The steps that follow are of this stream, which is named by its ``rank``, until ``go_on_with`` is called.
        ``ends``: the stream before has ended, and is never gone on with.

        Raises:
            RejectedStep: as of ``update``; neither the step nor its beginning has a key scan.
        """
        checked = self._back_end.checked(step)
        if self._log.steps == 0:
            self.reset()
            self._back_end.graph.share(rank)
            return self.update(step, optimize)
        begin = first_frame(checked) or checked
        if not self.may_join(begin):
            raise RejectedStep(f"step to {step.stamp_ns} ns has no key scan; expected one where an odometry begins")
        self._work()
        present = int(self._back_end.graph.ranks[-1])
        self._back_end.begin_stream(rank, ends)
        self._log.begin_stream(present)
        update = self._join_at(replace(begin, segment=True), np.zeros(3), OPEN, optimize)
        return update if begin is checked else self.update(step, optimize)

    def go_on_with(self, rank: int) -> None:
        """Let the next step go on with another stream."""
        self._work()
        present = int(self._back_end.graph.ranks[-1])
        if rank != present:
            frames = self._back_end.go_on_with(rank)
            self._log.go_on_with(rank, present, frames)
            self._online.set(self._online.values[frames])

    def walls(self, most: int) -> np.ndarray:
        """Points ``(n, 2)`` of all key scans at their corrected poses, thinned to about ``most``."""
        return self._back_end.walls(most)

    def planar_graph(self) -> PlanarGraph | None:
        """The graph of key scans as it is now; see ``CorrectedTrajectory.planar_graph``."""
        if self._log.steps == 0:
            return None
        back_end, graph = self._back_end, self._back_end.graph
        stamps_ns = self._log.stamps_ns.values[graph.frames.nodes]
        found = graph_of(stamps_ns, graph.poses.copy(), *back_end.measurements(), back_end.belief())
        return replace(found, ranks=graph.rank_of_frames[graph.frames.nodes])

    @property
    def identity(self) -> dict[str, Any]:
        """The settings: there are no networks."""
        return {"graph": asdict(self._config)}

    def _new_back_end(self) -> ScanBackEnd:
        return ScanBackEnd(self._config)


def first_frame(step: RelativeStep) -> RelativeStep | None:
    """A step that ends at the frame where an odometry begins, of its first ``step``; None where no scan shows that."""
    scan = step.origin_scan
    if scan is None:
        return None
    begin_ns = step.from_stamp_ns
    key = KeyScanStep(scan, begin_ns, np.zeros(3), OPEN)
    odom = compose(step.odom_xyyaw, between(step.relative_xyyaw, np.zeros(3)))
    return replace(
        step, stamp_ns=begin_ns, from_stamp_ns=begin_ns - 1, relative_xyyaw=np.zeros(3), covariance=OPEN,
        odom_xyyaw=odom, key=key, origin_scan=None, robot_odom_xyyaw=None,
    )  # fmt: skip
