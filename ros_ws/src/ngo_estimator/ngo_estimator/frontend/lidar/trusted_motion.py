"""The last scan that the robot can have reached by accelerating, and where its velocity leads.

Not in the paper. Scans that follow slipping wheels measure the slip as a velocity. No robot begins to move like that at
once, so that the velocity before it is still known.
"""

import math
from dataclasses import dataclass

from ngo_estimator.geometry.planar_motion import Array, arc_motion, arc_velocity, between, compose


@dataclass(frozen=True, eq=False)
class _Trusted:
    stamp_ns: int
    pose: Array
    velocity: Array
    proven: bool


class TrustedMotion:
    """Takes the pose of each scan, and keeps the last that is trusted.

    A robot changes its velocity by ``acceleration_m_s2`` and ``acceleration_rad_s2`` at most, and poses are off by up
    to ``still_m`` and ``still_rad``. After ``longest_s`` without a scan that is trusted nothing is known.
    """

    def __init__(
        self, still_m: float, still_rad: float, acceleration_m_s2: float, acceleration_rad_s2: float, longest_s: float
    ) -> None:
        self._still_m, self._still_rad = still_m, still_rad
        self._acceleration_m_s2, self._acceleration_rad_s2 = acceleration_m_s2, acceleration_rad_s2
        self._longest_s = longest_s
        self._last: _Trusted | None = None
        self._skipped = False  # the newest scan

    def observe(self, stamp_ns: int, pose: Array, velocity: Array, unsure: bool) -> None:
        """Take the newest scan's ``pose`` ``(3,)`` and ``velocity`` ``(3,)`` along the robot's axes (m/s, m/s, rad/s).

        Of an ``unsure`` scan neither is known.
        """
        last = self._last
        carried = None if last is None else self._led(last, stamp_ns)
        if last is not None and carried is not None and not unsure and self._reaches(last, carried, stamp_ns, pose):
            if self._skipped:  # the step from the scan before leads back from a slip as well
                velocity = arc_velocity(between(last.pose, pose), (stamp_ns - last.stamp_ns) * 1e-9)
            self._last, self._skipped = _Trusted(stamp_ns, pose, velocity, True), False
        elif carried is None or last is None or not last.proven:
            self._last, self._skipped = None if unsure else _Trusted(stamp_ns, pose, velocity, False), False
        else:
            self._skipped = True

    def carried(self, stamp_ns: int) -> Array | None:
        """Pose ``(3,)`` at a stamp by the trusted velocity; None where none is known that has led to a scan before."""
        return self._led(self._last, stamp_ns) if self._last is not None and self._last.proven else None

    @property
    def velocity(self) -> Array:
        """The trusted velocity ``(3,)`` along the robot's axes (m/s, m/s, rad/s), where ``carried`` knows a pose."""
        assert self._last is not None
        return self._last.velocity

    def forget(self) -> None:
        """Nothing measured the robot's motion."""
        self._last, self._skipped = None, False

    def _led(self, last: _Trusted, stamp_ns: int) -> Array | None:
        """Where the velocity of a scan leads until a stamp; None after ``longest_s``."""
        elapsed_s = (stamp_ns - last.stamp_ns) * 1e-9
        return None if elapsed_s > self._longest_s else compose(last.pose, arc_motion(last.velocity, elapsed_s))

    def _reaches(self, last: _Trusted, carried: Array, stamp_ns: int, pose: Array) -> bool:
        """Whether a robot can have accelerated from the last scan to a pose."""
        off, half = between(carried, pose), 0.5 * ((stamp_ns - last.stamp_ns) * 1e-9) ** 2
        near = math.hypot(off[0], off[1]) <= self._still_m + half * self._acceleration_m_s2
        return near and abs(off[2]) <= self._still_rad + half * self._acceleration_rad_s2
