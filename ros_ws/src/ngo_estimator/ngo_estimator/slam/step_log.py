"""The steps of a trajectory in their order: stamps, odometry, gaps and new beginnings."""

import math
from dataclasses import replace

import numpy as np

from ngo_estimator.data.relative_step import (
    LARGEST_ODOMETRY,
    LARGEST_VALUE,
    RESTART_AFTER_NS,
    DuplicateStep,
    LateStep,
    RelativeStep,
)
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry.se2 import between, compose, inverse


class StepLog:
    """Takes steps, and keeps stamps and odometry of all frames."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next step begins a new trajectory."""
        self._waiting: dict[int, tuple[int, np.ndarray]] = {}  # by rank, of the streams but the last
        self._fresh = False  # whether a stream begins with the next step
        self.stamps_ns = GrowingRows((), np.int64)
        self.odometry = GrowingRows((3,), np.float64)
        """Poses of all frames in the ``odom`` of the first; that of a later odometry is laid behind it."""
        self.odometry_std = GrowingRows((3,), np.float32)
        """Deviations of each step."""
        self._origin_stamp_ns = 0
        self._moved = np.zeros(3)  # what carries the poses of the present odometry into that of the first

    @property
    def steps(self) -> int:
        """Steps so far."""
        return max(0, len(self.stamps_ns) - 1)

    @property
    def last_odom(self) -> np.ndarray:
        """Pose ``(3,)`` of the newest frame, as ``odometry`` has it."""
        pose: np.ndarray = self.odometry.values[-1]
        return pose

    def is_restart(self, step: RelativeStep) -> bool:
        """Whether a step begins a new trajectory, for the motion since the last one is unknown.

        Its odometry has another origin, or it lies ``RESTART_AFTER_NS`` or more in the past, or ``LARGEST_VALUE`` away.
        """
        if self.steps == 0:
            return False
        last = int(self.stamps_ns.values[-1])
        if step.stamp_ns <= last - RESTART_AFTER_NS or step.origin_stamp_ns != self._origin_stamp_ns:
            return True
        # It would be so at every step to come.
        over_gap = step.stamp_ns > last != step.from_stamp_ns
        return over_gap and bool(np.abs(self._over_gap(step, last)[0]).max() > LARGEST_VALUE)

    def take(self, step: RelativeStep) -> RelativeStep:
        """Take the next step, which has been checked; after a restart a ``reset`` goes before.

        A step that begins after the last frame means lost steps: the motion between is composed from the poses in
        ``odom``.

        Returns:
            The step; another one, with the motion from the last frame, where steps were lost.

        Raises:
            DuplicateStep, LateStep: it is not newer than the last one. Nothing has changed.
        """
        if self.steps == 0:
            self._begin(step)
        elif step.stamp_ns <= (last := int(self.stamps_ns.values[-1])):
            kind = DuplicateStep if step.stamp_ns == last else LateStep
            raise kind(f"step to {step.stamp_ns} ns came when the trajectory was at {last} ns already")
        elif step.from_stamp_ns != last:
            relative, covariance = self._over_gap(step, last)
            step = replace(step, relative_xyyaw=relative, covariance=covariance)
        self._append(step.stamp_ns, self._laid(step.odom_xyyaw), step.covariance)
        return step

    def join(self, step: RelativeStep, relative: np.ndarray, covariance: np.ndarray) -> RelativeStep:
        """Take the frame that a step of another odometry ends at, and go on with that odometry.

        Args:
            relative: ``(3,)`` pose of the frame, seen from the newest one; covariance: ``(3, 3)`` of it.

        Returns:
            The step with this motion.

        Raises:
            LateStep: it is not newer than the last one. Nothing has changed.
        """
        self.check_later(step)
        laid = compose(self.last_odom, relative)
        self._moved = compose(laid, inverse(step.odom_xyyaw))
        self._origin_stamp_ns, self._fresh = step.origin_stamp_ns, False
        self._append(step.stamp_ns, laid, covariance)
        return replace(step, relative_xyyaw=relative, covariance=covariance)

    def begin_stream(self, present: int) -> None:
        """Let the next step, which ``join`` takes, begin another stream than that of the rank ``present``."""
        self._waiting[present], self._fresh = (self._origin_stamp_ns, self._moved), True

    def go_on_with(self, rank: int, present: int, order: np.ndarray) -> None:
        """Go on with another stream than that of the rank ``present``.

        ``order`` ``(frames,)`` are the old numbers of all frames in their new order.
        """
        self._waiting[present] = self._origin_stamp_ns, self._moved
        self._origin_stamp_ns, self._moved = self._waiting.pop(rank)
        self.stamps_ns.set(self.stamps_ns.values[order])
        self.odometry.set(self.odometry.values[order])
        unknown = np.full((1, 3), LARGEST_ODOMETRY, np.float32)
        self.odometry_std.set(np.concatenate((unknown, self.odometry_std.values))[order][1:])

    def keep(self, frames: np.ndarray) -> None:
        """Let go of the frames that are not among ``frames`` ``(n,)``, ascending; the first and the newest are."""
        variance = self.odometry_std.values.astype(np.float64) ** 2
        std = np.sqrt(np.add.reduceat(variance, frames[:-1]))
        self.stamps_ns.set(self.stamps_ns.values[frames])
        self.odometry.set(self.odometry.values[frames])
        self.odometry_std.set(np.minimum(std, LARGEST_ODOMETRY).astype(np.float32))

    def check_later(self, step: RelativeStep) -> None:
        """Raise ``LateStep`` if a step of another odometry is not newer than the last one."""
        last = int(self.stamps_ns.values[-1])
        if step.stamp_ns <= last and not self._fresh:
            raise LateStep(
                f"step to {step.stamp_ns} ns is of another odometry, and the loaded trajectory ends at {last} ns; "
                "expected later stamps"
            )

    def _append(self, stamp_ns: int, odometry: np.ndarray, covariance: np.ndarray) -> None:
        self.stamps_ns.append(stamp_ns)
        self.odometry.append(odometry)
        # Beyond it the motion is unknown all the same, and float32 would hold infinity, which no file takes.
        variances = np.diagonal(covariance).tolist()
        self.odometry_std.append([min(math.sqrt(variance), LARGEST_ODOMETRY) for variance in variances])

    def _laid(self, odom_xyyaw: np.ndarray) -> np.ndarray:
        """A pose ``(3,)`` of the present odometry, as ``odometry`` has it."""
        return compose(self._moved, odom_xyyaw) if self._moved.any() else odom_xyyaw

    SAVED = ("stamps_ns", "odometry", "odometry_std", "_origin_stamp_ns", "_moved")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        frames = len(self.stamps_ns)
        require(
            len(self.odometry) == frames and len(self.odometry_std) == max(0, frames - 1) and frames != 1,
            f"{frames} frames do not have as many poses, and a step less",
        )
        require(bool((np.diff(self.stamps_ns.values) > 0).all()), "the stamps do not ascend")

    def _over_gap(self, step: RelativeStep, last_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Relative pose and covariance from the last frame that is known to the one of ``step``.

        The covariance of the step stands for all that were lost, in proportion to the time that they took.
        """
        relative = between(self.last_odom, self._laid(step.odom_xyyaw))
        longer = (step.stamp_ns - last_ns) / (step.stamp_ns - step.from_stamp_ns)
        return relative, step.covariance * max(longer, 1.0)

    def _begin(self, step: RelativeStep) -> None:
        self._origin_stamp_ns = step.origin_stamp_ns
        self.stamps_ns.append(step.from_stamp_ns)
        self.odometry.append(compose(step.odom_xyyaw, inverse(step.relative_xyyaw)))
