"""The robot's own odometry on TF at the stamps of steps: steps wait for it, what is missing is said (no ROS here)."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_recordings.transform_buffer import TransformBuffer

_WAIT_NS = 2_500_000_000  # Transforms that are later by the scans' stamps are not waited for.

_SAID_AFTER_NS = 1_500_000_000


class OdometryOnTf:
    """Hands steps on in their order, each with the robot's pose in its own ``odom`` at the step's stamp.

    A step whose pose may still come waits. One whose pose does not come goes on without: no ``map`` -> ``odom`` follows
    from it.
    """

    def __init__(self, buffer: TransformBuffer, odom_frame: str, base_frame: str) -> None:
        self._buffer, self._frames = buffer, (odom_frame, base_frame)
        self.reset()

    def reset(self) -> None:
        """Forget the steps that wait, and for how long nothing was known."""
        self._steps: deque[RelativeStep] = deque()
        self._first_ns: int | None = None
        self._unknown_ns: int | None = None  # the first stamp since which nothing was known
        self._newest_ns = 0

    @property
    def waiting(self) -> int:
        """How many steps wait."""
        return len(self._steps)

    def add(self, step: RelativeStep) -> None:
        """Take a step."""
        self._first_ns = step.stamp_ns if self._first_ns is None else self._first_ns
        self._newest_ns = max(self._newest_ns, step.stamp_ns)
        self._steps.append(step)

    def ready(self, lag_s: float) -> Iterator[RelativeStep]:
        """The steps that need not wait; scans are older than their stamps by ``lag_s``."""
        while self._steps:
            step = self._steps[0]
            at_ns = step.stamp_ns - round(lag_s * 1e9)
            found = self._buffer.lookup(*self._frames, at_ns)
            if found is not None:
                self._unknown_ns = None
                pose = found.planar()[0]
            elif self._may_come(at_ns):
                return
            else:
                self._note(step.stamp_ns)
                pose = np.full(3, np.nan)
            yield replace(self._steps.popleft(), robot_odom_xyyaw=pose)

    def _may_come(self, stamp_ns: int) -> bool:
        self._note(stamp_ns)
        until_ns = self._buffer.known_until_ns(*self._frames)
        if until_ns is None:
            return self._newest_ns - (self._first_ns or 0) < _WAIT_NS
        return until_ns < stamp_ns and self._newest_ns - until_ns < _WAIT_NS

    def _note(self, stamp_ns: int) -> None:
        self._unknown_ns = stamp_ns if self._unknown_ns is None else min(self._unknown_ns, stamp_ns)

    def problem(self, held_ns: Sequence[int] = ()) -> str:
        """What is missing, where nothing was known for a while, also at the stamps of scans that are no steps yet."""
        since_ns, newest_ns = self._unknown_ns, self._newest_ns
        if held_ns and self._buffer.lookup(*self._frames, held_ns[0]) is None:
            since_ns, newest_ns = held_ns[0], held_ns[-1]
        if since_ns is None or newest_ns - since_ns < _SAID_AFTER_NS:
            return ""
        why = self._buffer.missing(*self._frames, newest_ns)
        return f"no map -> {self._frames[0]} for the newest scan: {why}" if why else ""
