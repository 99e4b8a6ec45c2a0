"""A calibrated camera's estimators over pictures and odometry of a recording, as the live nodes run (no ROS here)."""

from collections.abc import Iterable, Iterator
from typing import Any

from ngo_estimator.data.relative_step import RESTART_AFTER_NS
from ngo_estimator.frontend.camera.picture_odometry import SCALELESS, PictureOdometry
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep, Run, Truth
from ngo_estimator.slam.picture_trajectory import PictureTrajectory
from ngo_estimator.trajectory.files import seconds
from ngo_recordings.frames import Frame
from ngo_recordings.scan_stream import WheelPose

_UNPLACED = "no odometry at their stamps"
_AHEAD_NS = 500_000_000  # Odometry is given so far ahead of a picture.


class CameraRun(Run):
    """Feeds pictures and poses of the robot's odometry through both estimators as the nodes do with messages.

    Args:
        odometry, online: the estimators, which begin anew.
    """

    def __init__(self, odometry: PictureOdometry, online: PictureTrajectory) -> None:
        super().__init__(online, "picture")
        self._odometry = odometry
        self._steps = self._by_wheels = self._floorless = 0

    @property
    def facts(self) -> dict[str, Any]:
        """What else is worth keeping of the run."""
        return {"by_odometry_alone": self._by_wheels, "without_floor": self._floorless, **super().facts}

    def remarks(self) -> list[str]:
        """What a person should know of the run, a line each."""
        lines = []
        if self._by_wheels:
            lines.append(f"{self._by_wheels} of {self._steps} pictures told too little: {self._odometry.instead}")
        if self._floorless:
            lines.append(f"{self._floorless} of {self._steps} pictures showed too little of the floor: {SCALELESS}")
        if self._odometry.jumps:
            lines.append(f"the robot's odometry jumped {self._odometry.jumps} times: the motion is guessed there")
        return lines + super().remarks()

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
                self._reject_frame(frame.stamp_ns, error)
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
            self._reject("odometry not usable", f"{seconds(pose.stamp_ns)} s: {error}")

    def _ready(self, at_end: bool) -> Iterator[RecordedStep]:
        yield from map(self._step, self._odometry.ready(at_end))
        if unplaced := self._odometry.unplaced - self.rejected[_UNPLACED]:
            self.rejected[_UNPLACED] += unplaced
            self.examples.setdefault(_UNPLACED, self._odometry.clocks)

    def _finished(self, truth: Truth) -> Iterator[RecordedRun]:
        self._steps += self._odometry.frames
        self._by_wheels += self._odometry.by_wheels
        self._floorless += self._odometry.floorless
        yield from super()._finished(truth)


def _pieces(wheels: Iterable[WheelPose]) -> list[list[WheelPose]]:
    """The poses between two jumps back of their stamps, each piece sorted; a single pose that comes late is no jump."""
    recorded = list(wheels)
    pieces: list[list[WheelPose]] = [[]]
    newest_ns = 0
    for pose, following in zip(recorded, [*recorded, None][1:], strict=True):
        both_ns = max(pose.stamp_ns, pose.stamp_ns if following is None else following.stamp_ns)
        if pieces[-1] and both_ns <= newest_ns - RESTART_AFTER_NS:
            pieces.append([])
        newest_ns = max(newest_ns, pose.stamp_ns) if pieces[-1] else pose.stamp_ns
        pieces[-1].append(pose)
    return [sorted(piece, key=lambda each: each.stamp_ns) for piece in pieces]
