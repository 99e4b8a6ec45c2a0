"""What comes out of a recording, for runs of any sensor (no ROS here, and no torch)."""

from array import array
from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from ngo_estimator.trajectory.files import SpatialPoses
from ngo_estimator.trajectory.g2o import PlanarGraph
from ngo_recordings.frames import Frame


@dataclass(frozen=True)
class RecordedStep:
    """What came out of one frame: its motion since the frame before, and the trajectory after it."""

    local: RelativeStep
    update: TrajectoryUpdate


@dataclass(frozen=True)
class RecordedRun:
    """A whole trajectory, and the truth about its frames, where there is any.

    ``truth_residual`` ``(frames, 3)`` is what the projection to the plane leaves out of the truth (z m, roll rad, pitch
    rad). ``walls`` ``(n, 2)``: points of a lidar's scans at corrected poses.
    """

    trajectory: Trajectory
    graph: PlanarGraph
    truth: SpatialPoses | None
    truth_residual: np.ndarray
    walls: np.ndarray | None = None


class Truth:
    """The true poses of the frames of one trajectory, a few bytes each."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._values = array("d")

    def add(self, frame: Frame) -> None:
        """Take the true pose of a frame, where it is known."""
        if frame.pose_xyyaw is not None:
            residual = np.zeros(3) if frame.pose_residual is None else frame.pose_residual
            self._stamps_ns.append(frame.stamp_ns)
            self._values.extend((*frame.pose_xyyaw, *residual))

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def poses(self) -> tuple[SpatialPoses | None, np.ndarray]:
        """All of them, and what their projection to the plane leaves out ``(frames, 3)``."""
        values = np.array(self._values).reshape(-1, 6)
        if len(values) == 0:
            return None, values[:, 3:]
        return SpatialPoses.from_planar(np.array(self._stamps_ns), values[:, :3]), values[:, 3:]
