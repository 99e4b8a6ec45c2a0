"""The wheels by the scans: how far their clock is off, over any distance, and how far their scale is.

A robot turns by its scans when it turns by its wheels. The rates of both are correlated at all offsets between what was
heard last of each, so that no clock need be right.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from ngo_estimator.frontend.intake.imu_turns import ImuTurns
from ngo_estimator.frontend.intake.single_wheels import is_possible
from ngo_estimator.geometry.planar_motion import Array, between, compose, wrap

_CELL_S = 0.05
_KEPT_S = 120.0
_EVERY_S, _EVERY_SHARE = 2.0, 0.05
"""What is known is looked at so often, and when so much of it is new."""

_MOST_POSES = 20_000

_LEAST_S = 8.0
_LEAST_TURN_RAD = 2.0
"""Time and turn that both must have in common."""

_SURE = 0.8
_BETTER = 0.15
_OTHERS_S = 1.0
"""A correlation counts that is so high, and higher by so much than with no offset and than any so far away."""

_NEAR_S = 0.4
"""Offsets up to here are the age of scans, which the front end finds."""

_CONTRADICTS = 0.3
_MUCH_RAD = 6.0
"""Wheels that correlate less at any offset, while both turned so much, tell nothing."""

_NO_TURN, _NET_S = 0.01, 2.0
"""Wheels that turned by less of what the scans did have no heading; the noise of scans cancels in what is left of turns
after so long."""

_SLIP_RPS = 0.15
"""A wheel slips where the turn of the wheels is off from that of an IMU by more (rad/s)."""

_LONGEST_FREEZE_NS = 2_000_000_000
"""Wheels whose pose stays for so long froze, and catch up with what they missed; after longer they stood, unless the
scans moved by more than this in so long, and by so many deviations. Over a longer time the scans of a robot that stands
drift as far; in a corridor, at once."""

_FROZEN_M, _FROZEN_RAD, _FROZEN_NS, _FROZEN_DEVIATIONS = 0.3, 0.3, 5_000_000_000, 3.0

_BACK_M, _BACK_RAD = 0.05, 0.1
"""A step back to the origin that is less may be that of an encoder that dithers there."""

_SCALES = (0.7, 1.4)
"""Wheels within these are the front end's to judge."""

_LEAST_WAY_M = 2.0


@dataclass(frozen=True)
class WheelTruth:
    """What the scans say of the wheels.

    offset_s: how far their stamps are ahead of the scans'. turn_scale, way_scale: what their turns and ways must be
    multiplied by; negative where they count the other way round. useless: they say nothing about the robot's motion.
    age_s: how much older scans are than their stamps, by the wheels' clock, where it was learned before.
    """

    offset_s: float = 0.0
    turn_scale: float = 1.0
    way_scale: float = 1.0
    useless: bool = False
    age_s: float = 0.0

    def remarks(self) -> list[str]:
        """What is wrong with the wheels, a line each."""
        if self.useless:
            return ["the wheels do not turn when the scans do, at any offset of their clocks: they are left out"]
        lines = []
        if self.offset_s:
            side = "ahead of" if self.offset_s > 0.0 else "behind"
            lines.append(f"the wheels' clock is {abs(self.offset_s):.2f} s {side} the scans': corrected")
        if self.turn_scale != 1.0:
            why = "; or the scanner is upside down" if self.turn_scale < 0.0 else ""
            lines.append(f"the wheels' turns are taken times {self.turn_scale:.3g}, as the scans say{why}")
        if self.way_scale != 1.0:
            lines.append(f"the wheels' ways are taken times {self.way_scale:.3g}, as the scans say")
        return lines


class WheelClock:
    """Takes wheels and the motion by scans, and finds out about the wheels."""

    def __init__(self) -> None:
        self.truth = WheelTruth()
        self._scans: deque[tuple[int, int, float, float]] = deque()  # from, to (ns), turn, way
        self._wheels: deque[tuple[int, float, float]] = deque(maxlen=_MOST_POSES)  # ns, unwrapped yaw, way forward
        self._last: Array | None = None
        self._looked_ns = 0
        self._offset_s: float | None = None

    def add_wheels(self, stamp_ns: int, pose: Array) -> None:
        """Take a pose ``(3,)`` as the wheels say it."""
        yaw = way = 0.0
        if self._wheels:
            newest_ns, yaw, way = self._wheels[-1]
            if stamp_ns <= newest_ns:
                if stamp_ns > newest_ns - 1_000_000_000:
                    return
                self._wheels.clear()
        if self._last is not None:
            step = between(self._last, pose)
            yaw, way = yaw + wrap(float(step[2])), way + float(step[0])
        self._last = pose
        self._wheels.append((stamp_ns, yaw, way))

    def add_step(self, from_ns: int, to_ns: int, step: Array) -> bool:
        """Take the motion ``(3,)`` between two scans by the scans; returns whether something new is known."""
        if self._scans and to_ns <= self._scans[-1][1]:
            self._scans.clear()
            self._looked_ns = 0
        self._scans.append((from_ns, to_ns, float(step[2]), float(step[0])))
        while self._scans[0][1] < to_ns - _KEPT_S * 1e9:
            self._scans.popleft()
        known_ns = to_ns - self._scans[0][0]
        if to_ns < self._looked_ns + max(_EVERY_S * 1e9, _EVERY_SHARE * known_ns) or len(self._wheels) < 10:
            return False
        self._looked_ns = to_ns
        before = self.truth
        self._look()
        return self.truth != before

    def _look(self) -> None:
        scans, wheels = self._signals()
        if min(len(scans), len(wheels)) < _LEAST_S / _CELL_S:
            return
        turned = _turned(scans[:, 0]), _turned(wheels[:, 0])
        if turned[0] > _LEAST_TURN_RAD and turned[1] < _NO_TURN * turned[0]:
            self.truth = replace(self.truth, useless=True)
            return
        lags, correlation, turns = _correlation(scans[:, 0], wheels[:, 0])
        if not len(lags):
            return
        # The offset of a lag: the signals begin at stamps of their own.
        begin_s = (self._wheels[0][0] - self._scans[0][0]) * 1e-9
        offsets = begin_s + lags * _CELL_S
        best = int(np.argmax(correlation))
        if correlation.max() < _CONTRADICTS and -correlation.min() < _CONTRADICTS and turns.max() > _MUCH_RAD:
            self.truth = replace(self.truth, useless=True)
            return
        other_way = -correlation.min() > max(_SURE, correlation[best] + _BETTER)
        if other_way:
            correlation = -correlation
            best = int(np.argmax(correlation))
        if correlation[best] < _SURE:
            return
        self._judge_clock(offsets, correlation, best)
        near = np.abs(offsets - self.truth.offset_s) < _NEAR_S + _CELL_S
        if near.any():
            lag = int(lags[near][np.argmax(correlation[near])])
            self._judge_scale(*_aligned(scans, wheels, lag), -1.0 if other_way else 1.0)
            # Wheels that drive as no robot does would say that it stands, until their scale is known.
            self.truth = replace(self.truth, useless=self.truth.way_scale == 1.0 and _is_too_fast(wheels[:, 1]))

    def _judge_clock(self, offsets: Array, correlation: Array, best: int) -> None:
        here = np.abs(offsets - self.truth.offset_s) <= _NEAR_S
        others = np.abs(offsets - offsets[best]) > _OTHERS_S
        known = correlation[here].max(initial=0.0)
        if here[best] or correlation[best] < max(known, correlation[others].max(initial=0.0)) + _BETTER:
            return
        found_s = float(offsets[best])
        # Once is chance: the next look must say the same.
        if self._offset_s is not None and abs(self._offset_s - found_s) < 2.0 * _CELL_S:
            self.truth = replace(self.truth, offset_s=found_s)
        self._offset_s = found_s

    def _judge_scale(self, scans: Array, wheels: Array, turn_sign: float) -> None:
        energy = (scans**2).sum(axis=0), (wheels**2).sum(axis=0)
        product = (scans * wheels).sum(axis=0)
        turned, gone = np.abs(scans).sum(axis=0) * _CELL_S
        turn_scale, way_scale = self.truth.turn_scale, self.truth.way_scale
        if turned > 0.5 * _LEAST_TURN_RAD and product[0] * turn_sign > _SURE * math.sqrt(energy[0][0] * energy[1][0]):
            turn_scale = _far_off(turn_sign * math.sqrt(energy[0][0] / energy[1][0]))
        if gone > 0.5 * _LEAST_WAY_M and abs(product[1]) > _SURE * math.sqrt(energy[0][1] * energy[1][1]):
            way_scale = _far_off(math.copysign(math.sqrt(energy[0][1] / energy[1][1]), product[1]))
        old = self.truth
        if abs(turn_scale - old.turn_scale) > 0.1 or abs(way_scale - old.way_scale) > 0.1:
            self.truth = replace(old, turn_scale=turn_scale, way_scale=way_scale)

    def _signals(self) -> tuple[Array, Array]:
        """Rates of turn and way ``(cells, 2)``, by scans and by wheels, each from its first stamp on."""
        first_ns = self._scans[0][0]
        ends = np.array([(begin - first_ns, end - first_ns) for begin, end, *_ in self._scans]) * 1e-9
        moved = np.cumsum([step[2:] for step in self._scans], axis=0)
        stamps = np.concatenate((ends[:1, 0], ends[:, 1]))
        scans = _rates(stamps, np.concatenate((np.zeros((1, 2)), moved)), 0.0)
        while self._wheels[-1][0] - self._wheels[0][0] > (_KEPT_S + 20.0) * 1e9:
            self._wheels.popleft()
        stamps_ns = np.array([stamp_ns for stamp_ns, *_ in self._wheels])
        wheels = np.array([values for _, *values in self._wheels])
        period_s = float(np.median(np.diff(ends[:, 1]))) if len(ends) > 1 else 0.0
        return scans, _rates((stamps_ns - stamps_ns[0]) * 1e-9, wheels, period_s)


def _rates(stamps: Array, values: Array, over_s: float) -> Array:
    """Rates ``(cells, columns)`` of what was summed up, as means over so long."""
    times = np.arange(0.0, stamps[-1], _CELL_S)
    half = 0.5 * max(over_s, _CELL_S)
    columns = [
        (np.interp(times + half, stamps, column) - np.interp(times - half, stamps, column)) / (2.0 * half)
        for column in values.T
    ]
    return np.stack(columns, axis=-1)


def _turned(rates: Array) -> float:
    """What is left of turns after each time, summed up (rad)."""
    cells = round(_NET_S / _CELL_S)
    return float(np.abs(np.add.reduceat(rates, np.arange(0, len(rates), cells))).sum() * _CELL_S)


def _is_too_fast(speeds: Array) -> bool:
    """Whether no robot drives as these speeds mostly are (m/s)."""
    driven = np.abs(speeds[speeds != 0.0])
    return bool(len(driven)) and not is_possible(np.array((np.median(driven), 0.0, 0.0)), 1.0)


def _correlation(scans: Array, wheels: Array) -> tuple[Array, Array, Array]:
    """Lags ``(n,)`` (cells by which the wheels' signal begins later), the correlation at each, and the scans' turn
    (rad) in what both have in common there."""
    lags = np.arange(-len(scans) + 1, len(wheels))
    # What both have in common of the scans' signal, and of the wheels'.
    ours = np.maximum(-lags, 0), np.minimum(len(scans), len(wheels) - lags)
    its = np.maximum(lags, 0), np.minimum(len(wheels), len(scans) + lags)

    def sums(values: Array, common: tuple[Array, Array]) -> Array:
        upto = np.concatenate(([0.0], np.cumsum(values)))
        difference: Array = upto[common[1]] - upto[common[0]]
        return difference

    turned = sums(np.abs(scans), ours) * _CELL_S, sums(np.abs(wheels), its) * _CELL_S
    enough = (ours[1] - ours[0] > _LEAST_S / _CELL_S) & (np.minimum(*turned) > 0.5 * _LEAST_TURN_RAD)
    enough &= np.maximum(*turned) > _LEAST_TURN_RAD
    energies = sums(scans**2, ours)[enough] * sums(wheels**2, its)[enough]
    size = 1 << (len(scans) + len(wheels)).bit_length()
    products = np.fft.irfft(np.conj(np.fft.rfft(scans, size)) * np.fft.rfft(wheels, size), size)[lags[enough]]
    return lags[enough].astype(np.float64), products / np.sqrt(np.maximum(energies, 1e-12)), turned[0][enough]


def _aligned(scans: Array, wheels: Array, lag: int) -> tuple[Array, Array]:
    begin, end = max(0, -lag), min(len(scans), len(wheels) - lag)
    return scans[begin:end], wheels[begin + lag : end + lag]


def _far_off(scale: float) -> float:
    return 1.0 if _SCALES[0] < scale < _SCALES[1] else scale


class CorrectedWheels:
    """The wheels with what is known of them: their poses by the scans' clock, and by the scans' scale.

    A step that no robot makes is none, nor one back to the exact origin, where a driver begins anew. Where an IMU is
    used, turns are its own.
    """

    def __init__(self, imu: ImuTurns) -> None:
        self._imu = imu
        self._raw: deque[tuple[int, Array]] = deque(maxlen=2000)
        self._poses: deque[tuple[int, Array]] = deque(maxlen=2000)
        self._speed = np.zeros(2)  # while no wheel slipped
        self._moved_ns = 0  # the stamp at which a pose was last another one
        # Since then, of the last seconds: stamps, poses by scans, and variances of position and yaw, summed up.
        self._path: deque[tuple[int, Array, Array]] = deque()
        self.froze = False
        """Whether the pose ever stayed while the robot drove."""
        self._changed = False  # whether poses are no longer as the wheels say

    def add(self, stamp_ns: int, pose: Array, truth: WheelTruth) -> tuple[int, Array]:
        """Take a pose ``(3,)`` as the wheels say it; returns it as it should be."""
        if self._raw and stamp_ns <= self._raw[-1][0] - 1_000_000_000:
            self._raw.clear()
            self._poses.clear()
        scaled = pose
        if self._raw:
            turned = math.copysign(truth.way_scale, truth.way_scale * truth.turn_scale)
            step = between(self._raw[-1][1], pose) * (truth.way_scale, turned, truth.turn_scale)
            elapsed_s = (stamp_ns - self._raw[-1][0]) * 1e-9
            step[2] = wrap(float(step[2]))
            x, y, yaw = self._raw[-1][1]
            begins_anew = not pose.any() and (math.hypot(x, y) > _BACK_M or abs(wrap(float(yaw))) > _BACK_RAD)
            if begins_anew or not is_possible(step, elapsed_s):
                step, self._changed = np.zeros(3), True
            elif self._imu.used and step.any():
                offset_ns = round(truth.offset_s * 1e9)
                from_ns = max(self._moved_ns, stamp_ns - _LONGEST_FREEZE_NS)
                step, self._changed = self._turned(step, from_ns - offset_ns, stamp_ns - offset_ns), True
            self._changed |= (truth.turn_scale, truth.way_scale) != (1.0, 1.0)
            if self._changed:
                scaled = compose(self._poses[-1][1], step)
        made = stamp_ns + round((truth.age_s - truth.offset_s) * 1e9), scaled
        if not self._raw or stamp_ns > self._raw[-1][0]:
            if not self._raw or not np.array_equal(pose, self._raw[-1][1]):
                self._moved_ns = stamp_ns
                self._path.clear()
            self._raw.append((stamp_ns, pose))
            self._poses.append(made)
        return made

    def _turned(self, step: Array, from_ns: int, to_ns: int) -> Array:
        """A step of the wheels with the turn of the IMU, on the arc that belongs to it."""
        turn, elapsed_s = self._imu.turn(from_ns, to_ns), max((to_ns - from_ns) * 1e-9, 1e-3)
        if turn is None:
            return step
        chord = _rotated(step[:2], -0.5 * float(step[2]))  # from the middle of the arc
        if abs(turn - float(step[2])) < _SLIP_RPS * elapsed_s:
            self._speed = chord / elapsed_s
        else:  # a wheel slips: its way is as wrong as its turn
            chord = self._speed * elapsed_s
        return np.array((*_rotated(chord, 0.5 * turn), turn))

    def again(self, truth: WheelTruth) -> list[tuple[int, Array]]:
        """The last poses with what is known by now."""
        raw = list(self._raw)
        self._raw.clear()
        self._poses.clear()
        return [self.add(stamp_ns, pose, truth) for stamp_ns, pose in raw]

    def moved(self, step: Array, covariance: Array) -> None:
        """Take the motion ``(3,)`` from scan to scan, by the scans, and its covariance ``(3, 3)``."""
        if not self._raw:
            return
        now_ns, variances = self._raw[-1][0], np.array((covariance[0, 0] + covariance[1, 1], covariance[2, 2]))
        if self._path:
            step, variances = compose(self._path[-1][1], step), self._path[-1][2] + variances
        self._path.append((now_ns, step, variances))
        while self._path[0][0] < now_ns - _FROZEN_NS:
            self._path.popleft()
        if self.frozen:
            self.froze = self._changed = True

    @property
    def frozen(self) -> bool:
        """Whether the pose stays while the robot drives: it tells nothing then."""
        if not self._path or self._raw[-1][0] - self._moved_ns <= _LONGEST_FREEZE_NS:
            return False
        (_, begin, before), (_, end, after) = self._path[0], self._path[-1]
        x, y, turn = between(begin, end)
        least = np.maximum((_FROZEN_M, _FROZEN_RAD), _FROZEN_DEVIATIONS * np.sqrt(after - before))
        return bool(math.hypot(x, y) > least[0] or abs(wrap(turn)) > least[1])

    def motion(self, from_ns: int, to_ns: int) -> Array | None:
        """The motion ``(3,)`` between two stamps; None where it is not known."""
        begin, end = self._at(self._poses, from_ns), self._at(self._poses, to_ns)
        return None if self.frozen or begin is None or end is None else between(begin, end)

    def since(self, from_ns: int) -> Array | None:
        """The motion ``(3,)`` from a stamp to the newest pose; None where it is not known."""
        return self.motion(from_ns, self._poses[-1][0]) if self._poses else None

    def turn(self, from_ns: int, to_ns: int) -> float | None:
        """The turn between two stamps as the wheels say it (rad); None where it is not known."""
        begin, end = self._at(self._raw, from_ns), self._at(self._raw, to_ns)
        return None if self.frozen or begin is None or end is None else wrap(float(end[2] - begin[2]))

    def said(self, stamp_ns: int) -> Array | None:
        """The pose ``(3,)`` as the wheels say it, at a stamp by the scans' clock; None where it is not known, or is
        that of `add`."""
        return self._at(self._raw, stamp_ns) if self._changed else None

    def _at(self, poses: deque[tuple[int, Array]], stamp_ns: int) -> Array | None:
        index = len(self._poses) - 1
        while index >= 0 and self._poses[index][0] > stamp_ns:  # the newest are asked for
            index -= 1
        if index < 0 or (index == len(self._poses) - 1 and self._poses[index][0] < stamp_ns):
            return None
        (before_ns, _), before = self._poses[index], poses[index][1]
        if before_ns == stamp_ns:
            return before
        (after_ns, _), after = self._poses[index + 1], poses[index + 1][1]
        off = after - before
        off[2] = wrap(off[2])
        pose: Array = before + (stamp_ns - before_ns) / (after_ns - before_ns) * off
        return pose


def _rotated(vector: Array, angle: float) -> Array:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array((cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]))
