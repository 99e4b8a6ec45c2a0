"""Wheel odometry as the action of the local estimator: motion between two scans, and how far it may be wrong.

The wheels need no calibration: their deviations allow for it. Their stamps may be late or early against the scans',
which ``WheelLag`` finds out. They may freeze (``WheelFreezes``) and jump. Their direction tells how the scanner is
mounted (``MountingYaw``).
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from ngo_estimator.frontend.lidar.mounting_yaw import MountingYaw, MountingYawConfig
from ngo_estimator.frontend.lidar.wheel_freezes import WheelFreezes, WheelFreezesConfig
from ngo_estimator.frontend.lidar.wheel_lag import WheelLag, WheelLagConfig
from ngo_estimator.geometry.planar_motion import Array, arc_velocity, between, wrap

_STILL_RAD = 1e-9
"""Headings that differ by less are one: they were wrapped."""


@dataclass(frozen=True)
class WheelOdometryConfig:
    """How far wheels may be wrong, and how long poses are kept.

    The position's deviation is ``still_m``, and ``distance_share`` of the way, and ``turn_m`` a radian of turn; the
    heading's is ``still_deg``, and ``distance_deg`` a metre, and ``turn_share`` of the turn. ``kept`` poses are held.
    A pose is extrapolated by at most ``extrapolated_s``; later the wheels are silent.
    """

    still_m: float = 0.03
    distance_share: float = 0.1
    turn_m: float = 0.05
    still_deg: float = 1.0
    distance_deg: float = 4.0
    turn_share: float = 0.2
    kept: int = 1024
    extrapolated_s: float = 0.5
    lag: WheelLagConfig = field(default_factory=WheelLagConfig)
    freezes: WheelFreezesConfig = field(default_factory=WheelFreezesConfig)
    mounting_yaw: MountingYawConfig = field(default_factory=MountingYawConfig)

    def __post_init__(self) -> None:
        if not (self.still_m > 0.0 and self.still_deg > 0.0):
            raise ValueError(f"still_m, still_deg are {self.still_m}, {self.still_deg}; expected positive deviations")
        shares = (self.distance_share, self.turn_m, self.distance_deg, self.turn_share, self.extrapolated_s)
        if not all(0.0 <= share < math.inf for share in shares) or self.kept < 2:
            raise ValueError(
                f"distance_share, turn_m, distance_deg, turn_share, extrapolated_s are {shares} and kept is "
                f"{self.kept}; expected numbers of at least 0, and at least 2 poses"
            )

    def deviations(self, motion: Array) -> Array:
        """Deviations ``(3,)`` of a motion ``(3,)`` (m, m, rad)."""
        way, turn = math.hypot(motion[0], motion[1]), abs(motion[2])
        position = self.still_m + self.distance_share * way + self.turn_m * turn
        heading = math.radians(self.still_deg + self.distance_deg * way) + self.turn_share * turn
        return np.array((position, position, heading))


class WheelOdometry:
    """Stamped poses of the wheels, and the pose at any time among them; bounded memory."""

    def __init__(self, config: WheelOdometryConfig | None = None) -> None:
        self.config = config or WheelOdometryConfig()
        self.lag = WheelLag(self.config.lag)
        self.mounting_yaw = MountingYaw(self.config.mounting_yaw)
        self._freezes = WheelFreezes(self.config.freezes)
        self._rows = np.empty((2 * self.config.kept, 4))  # stamp in s since the first pose, x, y, unwrapped yaw
        self._count = 0
        self._origin_ns: int | None = None

    @property
    def lag_s(self) -> float:
        """How much older scans are than their stamps (s), by the wheels' clock; negative where wheels are older."""
        return self.lag.lag_s

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take the wheels' pose ``(3,)`` in their own frame; a stamp that is not newer than the last is dropped.

        Raises:
            ValueError: the pose has another shape or is not finite.
        """
        pose = np.asarray(pose, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise ValueError(f"the pose is {pose}; expected three finite numbers")
        if self._origin_ns is None:
            self._origin_ns = stamp_ns
        stamp_s = (stamp_ns - self._origin_ns) * 1e-9
        yaw = pose[2]
        if self._count:
            last = self._rows[self._count - 1]
            if stamp_s <= last[0]:
                return
            yaw = last[3] + wrap(yaw - last[3])
            if last[1] == pose[0] and last[2] == pose[1] and abs(last[3] - yaw) < _STILL_RAD:
                self._freezes.stood(float(last[0]), stamp_s, self._moved_before)
            else:
                self._freezes.moved(float(last[0]), stamp_s)
        if self._count == len(self._rows):
            self._rows[: self.config.kept] = self._rows[self.config.kept :].copy()
            self._count = self.config.kept
        self._rows[self._count] = stamp_s, pose[0], pose[1], yaw
        self._count += 1

    def pose_at(self, stamp_ns: int) -> Array | None:
        """The wheels' pose ``(3,)`` when a scan of this stamp was taken; None where they were silent."""
        if self._origin_ns is None:
            return None
        at = (stamp_ns - self._origin_ns) * 1e-9 - self.lag_s
        return _pose_at(self._rows, self._count, at, self.config.extrapolated_s)

    def frozen_s(self, stamp_ns: int) -> float:
        """For how long (s) the wheels had not counted when a scan of this stamp was taken; 0 where they counted."""
        at_s, since_s = self._frozen_since(stamp_ns)
        return 0.0 if since_s is None else at_s - since_s

    def velocity_before_freeze(self, stamp_ns: int) -> tuple[Array, Array] | None:
        """Velocity ``(3,)`` (m/s, m/s, rad/s) of the wheels before they froze, and its deviations ``(3,)``; None where
        they counted when a scan of this stamp was taken."""
        _, since_s = self._frozen_since(stamp_ns)
        if since_s is None:
            return None
        moved, elapsed_s = self._moved_before(since_s)
        if elapsed_s <= 0.0:  # so many readings came since then that none before is kept
            return None
        return arc_velocity(moved, elapsed_s), self.config.deviations(moved) / elapsed_s

    @property
    def freeze_lasts(self) -> bool:
        """The wheels froze and stand still, however long ago."""
        return self._freezes.lasts

    def _frozen_since(self, stamp_ns: int) -> tuple[float, float | None]:
        """When a scan of this stamp was taken, and since when the wheels had not counted then."""
        if self._origin_ns is None:
            return 0.0, None
        at_s = (stamp_ns - self._origin_ns) * 1e-9 - self.lag_s
        return at_s, self._freezes.since(at_s)

    def _moved_before(self, at_s: float) -> tuple[Array, float]:
        """What the wheels counted before the reading of a time, and in which time (s): at least ``braking_s``."""
        stamps_s = self._rows[: self._count, 0]
        last = int(np.searchsorted(stamps_s, at_s))
        first = max(int(np.searchsorted(stamps_s, at_s - self.config.freezes.braking_s, side="right")) - 1, 0)
        return between(self._rows[first, 1:], self._rows[last, 1:]), float(stamps_s[last] - stamps_s[first])

    def observe_turn(self, start_ns: int, end_ns: int, turn: float) -> None:
        """Take a turn (rad) that scans measured between their stamps: it tells the lag."""
        if self._origin_ns is None:
            return
        self.lag.observe((start_ns - self._origin_ns) * 1e-9, (end_ns - self._origin_ns) * 1e-9, turn)
        rows = self._rows[: self._count]
        self.lag.update(rows[:, 0], rows[:, 3])

    def observe_pose(self, stamp_ns: int, pose: Array | None) -> None:
        """Take the pose ``(3,)`` of a scan by the scans, None where they are not sure: it tells the mounting's yaw."""
        wheels = None if pose is None else self.pose_at(stamp_ns)
        if pose is None or wheels is None or self.frozen_s(stamp_ns) > 0.0:
            self.mounting_yaw.interrupt()
        else:
            self.mounting_yaw.observe(stamp_ns * 1e-9, pose, wheels)

    def motion(self, start: Array, end: Array) -> tuple[Array, Array]:
        """Motion ``(3,)`` between two of the wheels' poses, and the deviations ``(3,)`` of it."""
        moved = between(start, end)
        return moved, self.config.deviations(moved)


@njit(cache=True)
def _pose_at(rows: Array, count: int, at_s: float, extrapolated_s: float) -> Array | None:
    """The pose ``(3,)`` at a time among the first ``count`` rows; None where there is none."""
    if not rows[0, 0] - 1e-6 <= at_s <= rows[count - 1, 0] + extrapolated_s:
        return None
    if count == 1:
        return rows[0, 1:].copy()
    after = min(max(int(np.searchsorted(rows[:count, 0], at_s)), 1), count - 1)
    before, next_one = rows[after - 1], rows[after]
    share = (at_s - before[0]) / (next_one[0] - before[0])
    pose = before[1:] + share * (next_one[1:] - before[1:])
    pose[2] = wrap(pose[2])
    return pose
