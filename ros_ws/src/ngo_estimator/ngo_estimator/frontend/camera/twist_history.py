"""Velocities as they come, and their mean over a step (no ROS here)."""

from collections import deque

import numpy as np

from ngo_estimator.data.relative_step import RESTART_AFTER_NS

_KEPT = 4096


class TwistHistory:
    """The newest velocities ``(3,)`` (m/s forward, m/s left, rad/s), in the order of their stamps."""

    def __init__(self, tolerance_ns: int) -> None:
        if tolerance_ns < 0:
            raise ValueError(f"tolerance is {tolerance_ns} ns; expected at least 0")
        self._tolerance_ns = tolerance_ns
        self._twists: deque[tuple[int, np.ndarray]] = deque(maxlen=_KEPT)

    def clear(self) -> None:
        """Forget all."""
        self._twists.clear()

    def add(self, stamp_ns: int, twist_xyyaw: np.ndarray) -> None:
        """Take a velocity; one that is not newer than the last is ignored, unless its source restarted.

        Raises ``ValueError`` for values that are not three finite numbers.
        """
        twist = np.array(twist_xyyaw, dtype=np.float64)
        if twist.shape != (3,) or not np.isfinite(twist).all():
            raise ValueError(f"twist is {twist.tolist()}; expected three finite numbers")
        if self._twists and stamp_ns <= self._twists[-1][0]:
            if stamp_ns > self._twists[-1][0] - RESTART_AFTER_NS:
                return
            self.clear()
        self._twists.append((stamp_ns, twist))

    def forget_from(self, stamp_ns: int) -> None:
        """Forget those at this time and later: they are of a run that ended."""
        while self._twists and self._twists[-1][0] >= stamp_ns:
            self._twists.pop()

    def reaches(self, stamp_ns: int) -> bool:
        """Whether what is stamped up to this time is here, as far as it ever comes."""
        return bool(self._twists) and self._twists[-1][0] >= stamp_ns

    def mean(self, from_ns: int, to_ns: int) -> np.ndarray | None:
        """The mean ``(3,)`` of the velocities in ``(from_ns, to_ns]``, where there is none the newest one before.

        None where that one is older than the tolerance, counted from ``to_ns``. What lies before ``from_ns`` is
        forgotten, but for the newest.
        """
        if self._twists and self._twists[-1][0] <= from_ns - RESTART_AFTER_NS:
            return None  # of a restarted source, whose first frame is still on its way
        while len(self._twists) > 1 and self._twists[1][0] <= from_ns:
            self._twists.popleft()
        inside = [twist for stamp_ns, twist in self._twists if from_ns < stamp_ns <= to_ns]
        if inside:
            return np.mean(inside, axis=0)
        if self._twists and to_ns - self._tolerance_ns <= self._twists[0][0] <= from_ns:
            return self._twists[0][1]
        return None
