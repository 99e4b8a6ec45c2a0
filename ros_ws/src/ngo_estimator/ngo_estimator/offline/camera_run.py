"""A calibrated camera's estimators over pictures and odometry of a recording, as the live nodes run (no ROS here)."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from ngo_estimator.data.relative_step import RESTART_AFTER_NS
from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep, Truth
from ngo_estimator.slam.picture_trajectory import PictureTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory
from ngo_estimator.trajectory.files import seconds
from ngo_recordings.frames import Frame
from ngo_recordings.scan_stream import WheelPose

_REASONS: dict[type[ValueError], str] = {
    DuplicateFrame: "the stamp came twice",
    LateFrame: "older than the picture before",
}
_UNPLACED = "no odometry at their stamps"
_AHEAD_NS = 500_000_000
"""Odometry is given so far ahead of a picture."""


class CameraRun:
    """Feeds pictures and poses of the robot's odometry through both estimators as the nodes do with messages.

    Args:
        odometry, online: the estimators, which begin anew.
    """

    def __init__(self, odometry: PictureOdometry, online: PictureTrajectory) -> None:
        self._odometry, self._online = odometry, online
        self.frames = 0
        """Pictures that came."""
        self.rejected: Counter[str] = Counter()
        """Pictures and poses that were not used, by the reason."""
        self.examples: dict[str, str] = {}
        """For each reason the first such picture, in words."""
        self.gaps = 0
        """Steps that bridge pictures that were lost."""
        self.faults: list[str] = []
        """What failed inside, in words; the trajectory went on by odometry there."""
        self._steps = self._by_wheels = 0

    def trajectory(self) -> Trajectory | None:
        """The trajectory as it is now."""
        return self._online.trajectory()

    @property
    def facts(self) -> dict[str, Any]:
        """What else is worth keeping of the run."""
        return {"by_odometry_alone": self._by_wheels, "faults": len(self.faults)}

    def remarks(self) -> list[str]:
        """What a person should know of the run, a line each."""
        lines = []
        if self._by_wheels:
            lines.append(
                f"{self._by_wheels} of {self._steps} pictures told too little: the robot's odometry alone counts there"
            )
        if self._odometry.jumps:
            lines.append(f"the robot's odometry jumped {self._odometry.jumps} times: the motion is guessed there")
        if self.faults:
            lines.append(f"{len(self.faults)} faults, where it went on by odometry (first: {self.faults[0]})")
        return lines

    def run(self, frames: Iterable[Frame], wheels: Iterable[WheelPose]) -> Iterator[RecordedStep | RecordedRun]:
        """Every step, and after the last one of a trajectory the whole of it.

        A recording whose stamps jump back by a second or more holds several trajectories.

        Args:
            wheels: in the order in which they were recorded.
        """
        self._odometry.reset()
        self._online.reset()
        pieces = iter(_pieces(wheels))
        truth, poses = Truth(), iter(next(pieces, ()))
        pose, newest_ns = next(poses, None), 0
        for frame in frames:
            self.frames += 1
            if frame.stamp_ns <= newest_ns - RESTART_AFTER_NS:
                yield from self._ready(at_end=True)
                yield from self._finished(truth)
                self._odometry.reset()
                truth, poses = Truth(), iter(next(pieces, ()))
                pose, newest_ns = next(poses, None), frame.stamp_ns
            while pose is not None and pose.stamp_ns <= frame.stamp_ns + _AHEAD_NS:
                self._take_wheels(pose)
                pose = next(poses, None)
            try:
                self._odometry.add_picture(frame.stamp_ns, frame.image)
            except ValueError as error:
                reason = _REASONS.get(type(error), "not usable")
                self.rejected[reason] += 1
                self.examples.setdefault(reason, f"{seconds(frame.stamp_ns)} s: {error}")
                continue
            newest_ns = frame.stamp_ns
            truth.add(frame)
            yield from self._ready(at_end=False)
        yield from self._ready(at_end=True)
        yield from self._finished(truth)

    def _take_wheels(self, pose: WheelPose) -> None:
        try:
            self._odometry.add_wheels(pose.stamp_ns, pose.pose_xyyaw)
        except ValueError as error:
            self.rejected["odometry not usable"] += 1
            self.examples.setdefault("odometry not usable", f"{seconds(pose.stamp_ns)} s: {error}")

    def _ready(self, at_end: bool) -> Iterator[RecordedStep]:
        yield from self._steps_of(at_end)
        if unplaced := self._odometry.unplaced - self.rejected[_UNPLACED]:
            self.rejected[_UNPLACED] += unplaced
            self.examples.setdefault(_UNPLACED, self._odometry.clocks)

    def _steps_of(self, at_end: bool) -> Iterator[RecordedStep]:
        for step in self._odometry.ready(at_end):
            update = self._online.update(step)
            self.gaps += update.gap
            if self._online.fault:
                self.faults.append(self._online.fault)
            yield RecordedStep(step, update)

    def _finished(self, truth: Truth) -> Iterator[RecordedRun]:
        """The trajectory that ends here, if there is one."""
        self._online.finish()
        if self._online.fault:
            self.faults.append(self._online.fault)
        self._steps += self._odometry.frames
        self._by_wheels += self._odometry.by_wheels
        trajectory, graph = self._online.trajectory(), self._online.planar_graph()
        self._online.reset()
        if trajectory is not None and graph is not None:
            yield RecordedRun(trajectory, graph, *truth.poses())


def _pieces(wheels: Iterable[WheelPose]) -> list[list[WheelPose]]:
    """The poses between two jumps back of their stamps, each piece sorted; a single pose that comes late is no jump."""
    recorded = list(wheels)
    pieces: list[list[WheelPose]] = [[]]
    newest_ns = 0
    for pose, following in zip(recorded, [*recorded[1:], None], strict=True):
        both_ns = max(pose.stamp_ns, pose.stamp_ns if following is None else following.stamp_ns)
        if pieces[-1] and both_ns <= newest_ns - RESTART_AFTER_NS:
            pieces.append([])
        newest_ns = max(newest_ns, pose.stamp_ns) if pieces[-1] else pose.stamp_ns
        pieces[-1].append(pose)
    return [sorted(piece, key=lambda each: each.stamp_ns) for piece in pieces]
