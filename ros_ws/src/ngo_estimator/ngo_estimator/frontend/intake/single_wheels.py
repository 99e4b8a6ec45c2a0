"""The poses of one odometry where two publish on one topic or transform.

Steps that no robot makes tell them apart. An odometry that begins anew goes on from where it jumped to, and never comes
back. So a pose that is out of reach waits for the next one.

Two that begin at one place drift apart. They are known where they take turns: each pose goes on from the one before the
last. Of two rates they do not, and are told apart only out of reach.
"""

import math
from collections import deque

import numpy as np

from ngo_estimator.geometry.planar_motion import Array, between
from ngo_recordings.scan_stream import WheelPose

_FASTEST = (15.0, 10.0)
_AT_ONCE = (0.5, 1.0)
"""No robot goes or turns faster (m/s, rad/s), nor by more at once (m, rad)."""

_SILENT_NS = 1_000_000_000
"""After so long without a pose the one that comes counts."""

_LEAST = 0.02
"""Poses that are nearer (m, or rad) are not told apart."""

_POSES = 20
_SHARE = 0.8
"""Of so many poses, this share must go on from the one before the last."""


class SingleWheels:
    """Hands on the poses of the odometry that was heard first; of two that drift apart, those of either one."""

    def __init__(self) -> None:
        self.left_out = 0
        """How many poses are of another odometry."""
        self._last: WheelPose | None = None
        self._held: WheelPose | None = None
        self._other: WheelPose | None = None
        self._before: WheelPose | None = None
        self._alternates: deque[bool] = deque(maxlen=_POSES)

    def add(self, wheels: WheelPose) -> list[WheelPose]:
        """Take a pose; returns those that are to be used by now."""
        held, self._held = self._held, None
        if self._last is None or not _is_soon(self._last, wheels):
            self._last = wheels
            return [wheels] if held is None else [held, wheels]
        if _goes_on(self._last, wheels):
            if held is not None:
                self._other = held
                self.left_out += 1
            if self._is_of_other(self._last, wheels):
                self._other = wheels
                self.left_out += 1
                return []
            self._before, self._last = self._last, wheels
            return [wheels]
        if self._other is not None and _is_soon(self._other, wheels) and _goes_on(self._other, wheels):
            self._held, self._other = held, wheels
            self.left_out += 1
            return []
        if held is None:
            self._held = wheels
            return []
        self._last = held  # it began anew there, or moves as no robot does
        if _goes_on(held, wheels):
            self._last = wheels
            return [held, wheels]
        self._held = wheels
        return [held]

    def _is_of_other(self, last: WheelPose, wheels: WheelPose) -> bool:
        """Whether a pose within reach of the last one is of the other odometry."""
        if self._other is not None and _is_soon(self._other, wheels):
            return _is_nearer(self._other, last, wheels)
        self._alternates.append(self._before is not None and _is_nearer(self._before, last, wheels))
        if sum(self._alternates) < _SHARE * _POSES:
            return False
        self._alternates.clear()
        return True

    def remark(self) -> str:
        """In words; nothing where there is one odometry."""
        return (
            f"{self.left_out} poses of the wheels are of another odometry on the same topic: left out"
            if self.left_out
            else ""
        )


def is_possible(step: Array, elapsed_s: float) -> bool:
    """Whether a robot moves by a step ``(3,)`` within a time."""
    way, turn = math.hypot(step[0], step[1]), abs(math.remainder(step[2], math.tau))
    return way <= _FASTEST[0] * elapsed_s + _AT_ONCE[0] and turn <= _FASTEST[1] * elapsed_s + _AT_ONCE[1]


def _is_soon(before: WheelPose, after: WheelPose) -> bool:
    return abs(after.stamp_ns - before.stamp_ns) < _SILENT_NS


def _is_nearer(one: WheelPose, other: WheelPose, wheels: WheelPose) -> bool:
    """Whether a pose is clearly nearer to one than to another one."""
    near, far = (float(np.abs(between(each.pose_xyyaw, wheels.pose_xyyaw)).sum()) for each in (one, other))
    return far > _LEAST and near < 0.5 * far


def _goes_on(before: WheelPose, after: WheelPose) -> bool:
    elapsed_s = max(after.stamp_ns - before.stamp_ns, 0) * 1e-9
    return is_possible(between(before.pose_xyyaw, after.pose_xyyaw), elapsed_s)
