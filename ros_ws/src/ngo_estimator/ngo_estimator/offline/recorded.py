"""What comes out of a recording, and what runs of any sensor share (no ROS here, and no torch)."""

from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from ngo_estimator.trajectory.files import SpatialPoses, seconds
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


class Run:
    """Counts what becomes of the frames of a recording, and ends each of its trajectories.

    Args:
        online: the estimator of the trajectory, which begins anew.
        frame: what a frame of the sensor is called.
    """

    def __init__(self, online: CorrectedTrajectory, frame: str) -> None:
        self._online = online
        self._reasons: dict[type[ValueError], str] = {
            DuplicateFrame: "the stamp came twice",
            LateFrame: f"older than the {frame} before",
        }
        self.frames = 0
        """Frames that came."""
        self.rejected: Counter[str] = Counter()
        """Frames that were not used, by the reason."""
        self.examples: dict[str, str] = {}
        """For each reason the first such frame, in words."""
        self.gaps = 0
        """Steps that bridge frames that were lost."""
        self.faults: list[str] = []
        """What failed inside, in words; the trajectory went on by odometry there."""

    def trajectory(self) -> Trajectory | None:
        """The trajectory as it is now."""
        return self._online.trajectory()

    @property
    def facts(self) -> dict[str, Any]:
        """What else is worth keeping of the run."""
        return {"faults": len(self.faults)}

    def remarks(self) -> list[str]:
        """What a person should know of the run, a line each."""
        if not self.faults:
            return []
        return [f"{len(self.faults)} faults, where it went on by odometry (first: {self.faults[0]})"]

    def _reject(self, reason: str, example: str) -> None:
        self.rejected[reason] += 1
        self.examples.setdefault(reason, example)

    def _reject_frame(self, stamp_ns: int, error: ValueError) -> None:
        self._reject(self._reasons.get(type(error), "not usable"), f"{seconds(stamp_ns)} s: {error}")

    def _step(self, step: RelativeStep) -> RecordedStep:
        """Take a step; raises ``ValueError`` for one that cannot be used."""
        update = self._online.update(step)
        self.gaps += update.gap
        self._note_fault()
        return RecordedStep(step, update)

    def _note_fault(self) -> None:
        if self._online.fault:
            self.faults.append(self._online.fault)

    def _finished(self, truth: Truth) -> Iterator[RecordedRun]:
        """The trajectory that ends here, if there is one."""
        self._online.finish()
        self._note_fault()
        trajectory, graph, walls = self._online.trajectory(), self._online.planar_graph(), self._walls()
        self._online.reset()
        if trajectory is not None and graph is not None:
            yield RecordedRun(trajectory, graph, *truth.poses(), walls)

    def _walls(self) -> np.ndarray | None:
        """Points ``(n, 2)`` of a lidar's scans at corrected poses."""
        return None
