"""Pairs each frame with the action or the velocity that led to it, when they arrive in any order (no ROS here)."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.relative_step import RESTART_AFTER_NS
from ngo_estimator.frontend.camera.twist_history import TwistHistory
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame

_ACTIONS_KEPT = 4096


@dataclass(frozen=True)
class PairedFrame:
    """A frame, and the action and the mean velocity ``(3,)`` between the one before and it (None: not needed)."""

    stamp_ns: int
    image: np.ndarray
    action: int | None
    twist: np.ndarray | None = None


class FramePairing:
    """Holds frames back until the action, or the velocity, that led to them is known.

    An action carries the stamp of the frame at which it was taken. A frame is ready when the action of the
    last frame handed out is here; if that one is known to be lost, the first action between the two frames
    takes its place. Both streams are in order by themselves, so an action from the frame's own time or later
    says that no action between can come any more: the frame is dropped. It is also dropped once newer frames
    are ``timeout_ns`` ahead, or more than ``capacity`` frames wait. Nothing is made up for a lost action: the
    next frame spans the gap.

    Velocities are those of ``TwistHistory.mean`` between two frames, known once one from the later frame's time or
    after it is here, or the frame has waited as long as it may.
    """

    def __init__(
        self,
        needs_action: bool,
        timeout_ns: int,
        capacity: int,
        needs_twist: bool = False,
        twist_tolerance_ns: int = 500_000_000,
    ) -> None:
        if timeout_ns <= 0 or capacity < 1:
            raise ValueError(f"timeout is {timeout_ns} ns, capacity {capacity}; expected more than 0, at least 1")
        self._needs_action = needs_action
        self._needs_twist = needs_twist
        self._twists = TwistHistory(twist_tolerance_ns)
        self._timeout_ns = timeout_ns
        self._capacity = capacity
        self.dropped = 0
        """Frames given up because their action or velocity did not come."""
        self.reset()

    def reset(self) -> None:
        """Forget all frames, actions and velocities; ``dropped`` goes on."""
        self._twists.clear()
        self._waiting: deque[tuple[int, np.ndarray]] = deque()
        self._actions: deque[tuple[int, int]] = deque(maxlen=_ACTIONS_KEPT)
        self._last_ns: int | None = None

    @property
    def waiting(self) -> int:
        """How many frames wait for their action or velocity."""
        return len(self._waiting)

    def add_action(self, stamp_ns: int, action: int) -> None:
        """Take an action; one that is not newer than the last is ignored, unless its source restarted."""
        if self._actions and stamp_ns <= self._actions[-1][0]:
            if stamp_ns > self._actions[-1][0] - RESTART_AFTER_NS:
                return
            self._actions.clear()
        self._actions.append((stamp_ns, action))

    def add_twist(self, stamp_ns: int, twist_xyyaw: np.ndarray) -> None:
        """Take a velocity ``(3,)`` (m/s, m/s, rad/s); raises ``ValueError`` unless it is finite."""
        self._twists.add(stamp_ns, twist_xyyaw)

    def add_frame(self, stamp_ns: int, image: np.ndarray) -> None:
        """Take a frame.

        Raises:
            DuplicateFrame, LateFrame: it is not newer than the last one, but not as old as after a restart.
        """
        newest = self._waiting[-1][0] if self._waiting else self._last_ns
        if newest is not None and stamp_ns <= newest:
            if stamp_ns == newest:
                raise DuplicateFrame(f"frame at {stamp_ns} ns came twice")
            if stamp_ns > newest - RESTART_AFTER_NS:
                raise LateFrame(f"frame at {stamp_ns} ns is {(newest - stamp_ns) / 1e9:.3f} s older than the last")
            self.dropped += len(self._waiting)
            self._waiting.clear()
            self._last_ns = None
            # Actions of the new run may be here already; those of the old one are further ahead.
            of_new_run = [entry for entry in self._actions if entry[0] < stamp_ns + RESTART_AFTER_NS]
            self._actions = deque(of_new_run, maxlen=_ACTIONS_KEPT)
            self._twists.forget_from(stamp_ns + RESTART_AFTER_NS)
        self._waiting.append((stamp_ns, image))

    def ready(self) -> Iterator[PairedFrame]:
        """Hand out, in order, every frame whose action and velocity are known by now."""
        while self._waiting:
            stamp_ns, image = self._waiting[0]
            action = twist = None
            if self._last_ns is not None:
                if self._needs_action:
                    action = self._action_between(self._last_ns, stamp_ns)
                    if action is None and not self._is_lost(stamp_ns):
                        return
                if self._needs_twist:
                    if not self._twists.reaches(stamp_ns) and not self._has_waited(stamp_ns):
                        return
                    twist = self._twists.mean(self._last_ns, stamp_ns)
                if (self._needs_action and action is None) or (self._needs_twist and twist is None):
                    self._waiting.popleft()
                    self.dropped += 1
                    continue
            self._waiting.popleft()
            self._last_ns = stamp_ns
            yield PairedFrame(stamp_ns, image, action, twist)

    def _action_between(self, from_ns: int, to_ns: int) -> int | None:
        """The first action in ``[from_ns, to_ns)``; older ones are of no use any more and are forgotten."""
        if self._actions and self._actions[-1][0] <= from_ns - RESTART_AFTER_NS:
            return None  # of a restarted source, whose first frame is still on its way
        while self._actions and self._actions[0][0] < from_ns:
            self._actions.popleft()
        if self._actions and self._actions[0][0] < to_ns:
            return self._actions[0][1]
        return None

    def _is_lost(self, stamp_ns: int) -> bool:
        return (bool(self._actions) and self._actions[-1][0] >= stamp_ns) or self._has_waited(stamp_ns)

    def _has_waited(self, stamp_ns: int) -> bool:
        return self._waiting[-1][0] - stamp_ns >= self._timeout_ns or len(self._waiting) > self._capacity
