"""Where the next scan is expected: by the wheels, and by the velocity that the scans measured last.

The prior counts from the last key scan and not from the last scan, so that its deviations do not add up scan by scan.
Wheels that stand while the scans moved, or that run away from them (a jump), are doubted: for that scan the prior
widens by the disagreement, and both predictions are tried. The next prior counts from that scan. So it does where the
walls say that the velocity is right and the wheels are not (a slip). A slip that lasts leads the scans away one by one.
Therefore the velocity is that of the last scan which the robot can have reached by accelerating (``TrustedMotion``).
Wheels that froze (``WheelFreezes``) count for nothing. Once they count again, so does their whole way since before.
"""

import math
from dataclasses import dataclass

import numpy as np

from ngo_estimator.frontend.lidar.constant_velocity import ConstantVelocity
from ngo_estimator.frontend.lidar.motion_model import MotionModel
from ngo_estimator.frontend.lidar.standstill import StandstillBelief
from ngo_estimator.frontend.lidar.trusted_motion import TrustedMotion
from ngo_estimator.frontend.lidar.usual_motion import UsualMotion
from ngo_estimator.frontend.lidar.wheel_odometry import WheelOdometry
from ngo_estimator.geometry.planar_motion import Array, between, compose, inverted, squared_deviations, wrap

_FARTHEST = 5.0
"""Deviations from the velocity's place, from which on wheels that were silent began anew."""

_COVERED = 0.5
"""Share of the time since the last scan that wheels must have counted to tell the motion."""


@dataclass(frozen=True)
class MotionPriorConfig:
    """How far predictions may be wrong.

    Without wheels the velocity goes on as the robot's did before (``MotionModel``), or is constant where that is not
    known, up to ``acceleration_m_s2`` and ``acceleration_rad_s2``, beside ``still_m`` and ``still_deg``, at most
    ``largest_m`` and ``largest_deg``; after ``longest_s`` it counts as zero. Where nothing measures it, its deviation
    grows to ``largest_m_s`` and ``largest_rad_s``. Robots that were seen to change their speed by more get more of both
    (``UsualMotion``). Wheels are doubted where they differ from constant velocity by more than ``doubt_m`` and
    ``doubt_m_s2``, or ``doubt_deg`` and ``acceleration_rad_s2``, allow, or where they stand exactly still, for at most
    ``longest_freeze_s``, while constant velocity moves by ``frozen_m``. Wheels that did not count for up to
    ``longest_silence_s`` tell the whole way since then.
    """

    still_m: float = 0.03
    still_deg: float = 1.5
    acceleration_m_s2: float = 2.0
    acceleration_rad_s2: float = 4.0
    largest_m: float = 1.0
    largest_deg: float = 45.0
    longest_s: float = 1.5
    largest_m_s: float = 0.3
    largest_rad_s: float = 1.0
    doubt_m: float = 0.1
    doubt_m_s2: float = 4.0
    doubt_deg: float = 10.0
    frozen_m: float = 0.01
    longest_freeze_s: float = 2.0
    longest_silence_s: float = 3.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} is {value}; expected a positive number")


@dataclass(frozen=True, eq=False)
class Prediction:
    """The prior of a scan's pose in the odometry's frame: ``mean`` ``(3,)`` with ``covariance`` and ``information``
    ``(3, 3)``. Registrations begin at ``starts``, the likeliest first. ``by_wheels`` says that wheels made it, and
    ``measured`` that they are not doubted, ``moved`` that they count a motion as well: wheels that stand exactly still
    may be frozen. Where they moved since the last scan, ``step_covariance`` ``(3, 3)`` is that of this motion, along
    the odometry's axes. Where no wheels lead, ``standing`` says that the robot is believed to stand."""

    mean: Array
    covariance: Array
    information: Array
    starts: tuple[Array, ...]
    by_wheels: bool = False
    measured: bool = False
    moved: bool = False
    step_covariance: Array | None = None
    standing: bool = False


class MotionPrior:
    """Keeps the last motion, and the last key scan's pose with the wheels' pose there."""

    def __init__(self, config: MotionPriorConfig) -> None:
        self.config = config
        self._stamp_ns = 0
        self._motion = ConstantVelocity(np.array((config.largest_m_s, config.largest_m_s, config.largest_rad_s)))
        self._usual = UsualMotion(config.largest_m_s)
        self._model = MotionModel()
        self._standstill = StandstillBelief(config.acceleration_m_s2)
        self._expected: Array | None = None  # by the velocity alone
        self._standing = False  # as it was predicted last
        self._anchor = np.zeros(3)
        self._anchor_wheels: Array | None = None
        self._last_wheels: Array | None = None
        self._now_wheels: Array | None = None
        self._anchor_covariance = np.zeros((3, 3))
        self._doubted = False
        self._moved_ns = 0  # when the wheels moved last
        self._counted_ns = 0  # when they told the motion last
        self._trusted = TrustedMotion(
            config.still_m,
            math.radians(config.still_deg),
            config.acceleration_m_s2,
            config.acceleration_rad_s2,
            config.longest_s,
        )
        self.slips = False
        """The walls told a slip, and the wheels have not agreed with the velocity since."""

    def begin(self, stamp_ns: int, pose: Array, wheels: WheelOdometry | None) -> None:
        """The first scan is a key scan at this pose."""
        self._stamp_ns, self._anchor = stamp_ns, pose
        self._moved_ns = self._counted_ns = stamp_ns
        self._last_wheels = self._anchor_wheels = None if wheels is None else wheels.pose_at(stamp_ns)

    def predict(
        self, stamp_ns: int, last: Array, covariance: Array, wheels: WheelOdometry | None, stands: bool = False
    ) -> Prediction:
        """The prior of the scan at a stamp, after the last one had the pose ``last`` ``(3,)``.

        ``covariance`` ``(3, 3)`` is that of ``last`` against the last key scans. It counts where wheels do not lead
        back to a key scan. ``stands``: the ranges look as if the robot stands.
        """
        elapsed = (stamp_ns - self._stamp_ns) * 1e-9
        if elapsed > self.config.longest_s:
            self._motion.forget()
        self._now_wheels = None if wheels is None else wheels.pose_at(stamp_ns)
        if wheels is not None and wheels.frozen_s(stamp_ns) > (1.0 - _COVERED) * elapsed:
            self._now_wheels = None
        if wheels is not None and self._now_wheels is None and self._last_wheels is not None:
            self._begin_silence(stamp_ns, last, covariance, wheels)
        if wheels is None or self._now_wheels is None or self._last_wheels is None:
            carried = self._without_wheels(last, elapsed, self._standstill.stands(stamp_ns, stands))
            again = None if wheels is None else self._counting_again(carried, wheels)
            return again or carried
        constant = self._motion.velocity * elapsed
        step, step_deviations = wheels.motion(self._last_wheels, self._now_wheels)
        self._expected = None
        starts = [compose(last, step)]
        off, off_rad = math.hypot(step[0] - constant[0], step[1] - constant[1]), abs(wrap(step[2] - constant[2]))
        turn_doubt = math.radians(self.config.doubt_deg) + self.config.acceleration_rad_s2 * elapsed**2
        jumped = off > self.config.doubt_m + self.config.doubt_m_s2 * elapsed**2 or off_rad > turn_doubt
        doubted = jumped or self._is_frozen(stamp_ns, step, constant)
        if doubted:
            starts.append(compose(last, constant))
        if doubted or self._doubted or self._anchor_wheels is None:
            # The wheels' way since the key scan is wrong by what was doubted: count from the last scan.
            self._anchor, self._anchor_wheels, self._anchor_covariance = last, self._last_wheels, covariance
        self._doubted = doubted
        moved, deviations = wheels.motion(self._anchor_wheels, self._now_wheels)
        if doubted:
            deviations = deviations + np.array((off, off, off_rad))
        total = np.diag(deviations**2) + self._anchor_covariance
        return Prediction(
            compose(self._anchor, moved),
            total,
            inverted(total),
            tuple(starts),
            by_wheels=True,
            measured=not doubted,
            moved=not doubted and bool(step.any()),
            step_covariance=np.diag(step_deviations**2) if not doubted and step.any() else None,
        )

    def _begin_silence(self, stamp_ns: int, last: Array, covariance: Array, wheels: WheelOdometry) -> None:
        """Silent wheels leave the pose from which they will count again, and their velocity if they froze."""
        if self._doubted:
            self._anchor, self._anchor_wheels, self._anchor_covariance = last, self._last_wheels, covariance
        before = wheels.velocity_before_freeze(stamp_ns)
        if before is not None:
            velocity, deviations = before
            self._motion.begin(velocity, np.diag(deviations**2))

    def _counting_again(self, carried: Prediction, wheels: WheelOdometry) -> Prediction | None:
        """The prior by the wheels' whole way since before they fell silent, beside that of the velocity.

        None where they are silent, or began anew: their way does not fit the other prior.
        """
        if self._anchor_wheels is None or self._now_wheels is None:
            return None
        moved, deviations = wheels.motion(self._anchor_wheels, self._now_wheels)
        mean, total = compose(self._anchor, moved), np.diag(deviations**2) + self._anchor_covariance
        if squared_deviations(mean, carried.mean, inverted(total + carried.covariance)) > _FARTHEST**2:
            self._anchor_wheels = None
            return None
        # Wheels that stand ever since: the robot stopped at once, or they freeze for longer than others.
        self._expected, self._doubted = None, wheels.freeze_lasts
        if self._doubted:
            off = mean - carried.mean
            off[2] = wrap(off[2])
            total = total + np.outer(off, off)
        starts, counted = (mean, *carried.starts), not self._doubted
        return Prediction(mean, total, inverted(total), starts, by_wheels=True, measured=counted, moved=counted)

    def without_slip(
        self, stamp_ns: int, last: Array, covariance: Array, wheels: WheelOdometry, prediction: Prediction
    ) -> tuple[Prediction, Array] | None:
        """Another prior of the scan whose ``prediction`` wheels made: that of wheels that slipped. And its velocity
        ``(3,)`` (m/s, m/s, rad/s).

        It begins where the velocity leads from the last trusted scan, and is as wide as both disagree. It is None where
        nothing else is known: no velocity is trusted, or it agrees with the wheels within their deviations, or these
        just count again.
        """
        carried = self._trusted.carried(stamp_ns)
        if self._last_wheels is None or self._now_wheels is None or carried is None:
            return None
        step, deviations = wheels.motion(self._last_wheels, self._now_wheels)
        mean = compose(last, step)
        off, off_prediction = between(mean, carried), between(prediction.mean, carried)
        # A slip since the last key scan leads astray as well.
        agree = (off_prediction**2 <= prediction.covariance.diagonal()).all()
        if agree and (np.abs(off) <= deviations).all():
            self.slips = False
            return None
        off_m = math.hypot(off[0], off[1])
        total = np.diag((deviations + np.array((off_m, off_m, abs(off[2])))) ** 2) + covariance
        return Prediction(mean, total, inverted(total), (carried,), by_wheels=True), self._trusted.velocity

    def judge(self, slips: bool) -> None:
        """The walls told whether the wheels slip. If they do, the next prior counts from the newest scan."""
        self.slips = slips
        self._doubted = self._doubted or slips

    def _is_frozen(self, stamp_ns: int, step: Array, constant: Array) -> bool:
        """Whether wheels that stand exactly still may have stopped counting."""
        config = self.config
        if step.any():
            self._moved_ns = stamp_ns
        still_s = (stamp_ns - self._moved_ns) * 1e-9
        moves = math.hypot(constant[0], constant[1]) > config.frozen_m or abs(constant[2]) > math.radians(
            config.still_deg
        )
        return not step.any() and moves and still_s <= config.longest_freeze_s

    def _without_wheels(self, last: Array, elapsed: float, stands: bool) -> Prediction:
        config = self.config
        still = np.array((config.still_m, config.still_m, math.radians(config.still_deg)))
        largest = np.array((config.largest_m, config.largest_m, math.radians(config.largest_deg)))
        changes = 0.5 * self._changes(elapsed)
        changes[:2] = np.maximum(changes[:2], self._usual.rate_m_s * math.sqrt(elapsed))
        changes = np.minimum(changes, largest / elapsed)
        self._motion.largest[:2] = self._usual.largest_m_s
        # A robot that stands may go on standing, which its model seldom saw.
        known = elapsed <= config.longest_s and not stands
        following = self._model.after(self._motion.velocity, elapsed) if known else None
        total = self._motion.predict(last[2], elapsed, still, changes, following)
        self._expected = mean = compose(last, self._motion.velocity * elapsed)
        self._standing = stands
        return Prediction(mean, total, inverted(total), (mean,), standing=stands)

    def accept(
        self,
        stamp_ns: int,
        pose: Array,
        covariance: Array,
        step: Array,
        step_covariance: Array,
        passes: bool,
        is_key: bool,
        unsure: bool,
    ) -> Array:
        """The scan that was predicted last had this pose ``(3,)``, a step ``(3,)`` after the one before.

        ``covariance`` and ``step_covariance`` ``(3, 3)`` are those of both: a direction that the walls leave open tells
        no velocity. A step that is ``unsure`` is no measured velocity: without wheels the last one is believed less and
        less. The next priors count from a scan that ``passes``, or ``is_key``, of which the covariances count.

        Returns:
            The covariance ``(3, 3)`` that the pose's lacks in a sum of independent steps, along the odometry's axes.
        """
        elapsed = (stamp_ns - self._stamp_ns) * 1e-9
        if self._expected is None:
            self._motion.measure(step / elapsed, step_covariance / elapsed**2, self._changes(elapsed))
            self._usual.interrupt()
            self._model.interrupt()
        else:
            change = pose - self._expected
            change[2] = wrap(change[2])
            self._motion.update(change, covariance)
            if unsure or float(np.linalg.eigvalsh(covariance[:2, :2])[-1]) > self.config.still_m**2:
                self._usual.interrupt()
                self._model.interrupt()
            else:
                self._usual.observe(step, elapsed)
                if self._standing or elapsed > self.config.longest_s:
                    self._model.interrupt()
                if not self._standing:
                    self._model.observe(step / elapsed, elapsed)
                self._standstill.observe(stamp_ns, math.hypot(step[0], step[1]) / elapsed)
            if unsure and not self._silent:
                self._motion.velocity = 0.5 * self._motion.velocity
        if self._now_wheels is None or self._last_wheels is None:
            self._trusted.forget()
            self.slips = False
        else:
            self._trusted.observe(stamp_ns, pose, self._motion.velocity, unsure)
        shared = self._motion.shared()
        self._stamp_ns, self._last_wheels = stamp_ns, self._now_wheels
        if self._now_wheels is not None:
            self._counted_ns = stamp_ns
        elif (stamp_ns - self._counted_ns) * 1e-9 > self.config.longest_silence_s:
            self._anchor_wheels = None
        if self._silent:
            # The wheels will count from before. The covariances will count from a key scan that may be elsewhere.
            if is_key:
                self._anchor_covariance = self._anchor_covariance + covariance + shared
        elif passes or is_key:
            self._anchor, self._anchor_wheels = pose, self._now_wheels
            self._anchor_covariance = np.zeros((3, 3)) if is_key else covariance
            self._doubted = False
        if is_key:
            self._motion.begin_at_key()
        return shared

    @property
    def _silent(self) -> bool:
        """Wheels that do not count now will count again from where they fell silent."""
        return self._now_wheels is None and self._anchor_wheels is not None

    def _changes(self, elapsed: float) -> Array:
        """Deviations ``(3,)`` of the change of a velocity."""
        config = self.config
        return elapsed * np.array((config.acceleration_m_s2, config.acceleration_m_s2, config.acceleration_rad_s2))
