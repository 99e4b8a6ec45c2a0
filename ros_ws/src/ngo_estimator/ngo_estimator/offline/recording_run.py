"""Both estimators over the frames of a recording, as the live nodes compute without their middleware (no ROS here)."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from ngo_estimator.data.observations import observation
from ngo_estimator.data.relative_step import RESTART_AFTER_NS, UNFAMILIAR
from ngo_estimator.frontend.camera.familiarity_watch import NOT_FITTED
from ngo_estimator.frontend.camera.frame_pairing import FramePairing, PairedFrame
from ngo_estimator.frontend.camera.local_odometry import AT_ONCE, LocalOdometry
from ngo_estimator.frontend.rejected_frames import RejectedFrame
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep, Run, Truth
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.trajectory.files import seconds
from ngo_recordings.frames import Frame


class RecordingRun(Run):
    """Feeds frames through both cores as the nodes do with messages, the networks several frames at once.

    Args:
        local, online: the cores, which begin anew.
        action_timeout_ns, action_capacity: as in ``FramePairing``.
        scan_yaw_rad: where a scanner's angle 0 points, counter-clockwise from straight ahead.
    """

    def __init__(
        self,
        local: LocalOdometry,
        online: OnlineTrajectory,
        action_timeout_ns: int = 1_000_000_000,
        action_capacity: int = 64,
        scan_yaw_rad: float = 0.0,
    ) -> None:
        super().__init__(online, "frame")
        self._local, self._scan_yaw_rad = local, scan_yaw_rad
        self._pairing = FramePairing(local.uses_action, action_timeout_ns, action_capacity, local.uses_twist)
        self._unlikeness: list[float] = []
        self._repeated = 0

    @property
    def facts(self) -> dict[str, Any]:
        """What else is worth keeping of the run."""
        if not self._local.tells_unlike_input:
            return {"unlikeness": None, **super().facts}
        values = np.array(self._unlikeness or [0.0])
        return {
            "unlikeness": {"median": float(np.median(values)), "largest": float(values.max())},
            "unfamiliar_frames": int((values > UNFAMILIAR).sum()),
            "repeated_frames": self._repeated,
            **super().facts,
        }

    def remarks(self) -> list[str]:
        """What a person should know of the run, a line each."""
        if not self._local.tells_unlike_input:
            return [NOT_FITTED, *super().remarks()]
        values, lines = np.array(self._unlikeness), []
        if unfamiliar := int((values > UNFAMILIAR).sum()):
            lines.append(
                f"{unfamiliar} of {len(values)} frames are unlike what the networks learned from (unlikeness up to "
                f"{values.max():.3g}, 1 is the limit): deviations grow there, and nothing is corrected by them"
            )
        if self._repeated:
            lines.append(f"{self._repeated} frames repeat the one before while the robot was told to move")
        return lines + super().remarks()

    def run(self, frames: Iterable[Frame]) -> Iterator[RecordedStep | RecordedRun]:
        """Every step, and after the last one of a trajectory the whole of it.

        A recording whose stamps jump back by a second or more holds several trajectories.

        Raises:
            ValueError: frames that cannot be used lie between two whose odometry is too far apart to go on; live, the
                trajectory would begin anew.
        """
        self._local.reset()
        self._online.reset()
        self._pairing.reset()
        self._paired: list[PairedFrame] = []
        truth, before_ns = Truth(), None
        for frame in frames:
            self.frames += 1
            if before_ns is not None and frame.stamp_ns <= before_ns - RESTART_AFTER_NS:
                yield from self._ended(truth)
                truth, before_ns = Truth(), None
            # What led to a frame, stamped as in the messages: an action at the frame before, a velocity up to its own.
            if frame.action is not None and before_ns is not None and before_ns < frame.stamp_ns:
                self._pairing.add_action(before_ns, frame.action)
            if frame.twist_xyyaw is not None:
                self._pairing.add_twist(frame.stamp_ns, frame.twist_xyyaw)
            before_ns = frame.stamp_ns if before_ns is None else max(before_ns, frame.stamp_ns)
            if not self._taken(frame):
                continue
            truth.add(frame)
            self._paired += self._pairing.ready()
            while len(self._paired) >= AT_ONCE:
                yield from self._steps()
        yield from self._ended(truth)
        if missing := self._pairing.dropped + self._pairing.waiting:
            self.rejected["no action or velocity led to it"] = missing

    def _taken(self, frame: Frame) -> bool:
        """Whether the frame is of the right kind and size, and newer than those before."""
        try:
            image = observation(self._local.image_format, frame.image, frame.scan, self._scan_yaw_rad)
            self._pairing.add_frame(frame.stamp_ns, image)
        except ValueError as error:
            self._reject_frame(frame.stamp_ns, error)
            return False
        return True

    def _steps(self) -> Iterator[RecordedStep]:
        """Those of the next frames, as many as the networks take at once."""
        pairs, self._paired = self._paired[:AT_ONCE], self._paired[AT_ONCE:]
        for pair, local in zip(pairs, self._local.update_all(pairs), strict=True):
            try:
                if isinstance(local, RejectedFrame):
                    raise local
                if local is None:
                    continue
                taken = self._step(local)
            except ValueError as error:
                self._reject("not usable", f"{seconds(pair.stamp_ns)} s: {error}")
                continue
            if taken.update.restarted:
                raise ValueError(
                    f"the odometry goes too far from one frame to the next at {seconds(local.stamp_ns)} s: split the "
                    "recording there, or use weights that know this robot"
                )
            self.gaps += local.missed_frames > 0 and not taken.update.gap
            self._unlikeness.append(local.unlikeness)
            self._repeated += local.repeated
            yield taken

    def _ended(self, truth: Truth) -> Iterator[RecordedStep | RecordedRun]:
        """The last steps of the trajectory that ends here, and the whole of it, if there is one."""
        yield from self._steps()
        self._local.reset()
        yield from self._finished(truth)
