"""The online trajectory of a 2D lidar: relative poses and key scans in, the whole corrected trajectory out (no ROS)."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.data.relative_step import RelativeStep
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

    def begin_segment(self, step: RelativeStep) -> TrajectoryUpdate:
        """Go on with another odometry, from the frame that ``step`` ends at; nobody knows where that is in the map.

        Raises:
            RejectedStep: as of ``update``; the stamp is not later than the newest one, or the step has no key scan.
        """
        return self._join_at(replace(self._back_end.checked(step), segment=True), np.zeros(3), OPEN)

    def walls(self, most: int) -> np.ndarray:
        """Points ``(n, 2)`` of all key scans at their corrected poses, thinned to about ``most``."""
        return self._back_end.walls(most)

    def planar_graph(self) -> PlanarGraph | None:
        """The graph of key scans as it is now; see ``CorrectedTrajectory.planar_graph``."""
        if self._log.steps == 0:
            return None
        back_end, graph = self._back_end, self._back_end.graph
        frames, measured = graph.frames.nodes, back_end.measurements()
        return graph_of(self._log.stamps_ns.values[frames], graph.poses.copy(), *measured, back_end.belief())

    @property
    def identity(self) -> dict[str, Any]:
        """The settings: there are no networks."""
        return {"graph": asdict(self._config)}

    def _new_back_end(self) -> ScanBackEnd:
        return ScanBackEnd(self._config)
