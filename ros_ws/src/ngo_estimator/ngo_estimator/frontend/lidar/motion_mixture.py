"""Where a robot may be after its last scan: hypotheses of its motion, whose weights and deviations matches teach.

Each hypothesis has a mean motion and deviations that grow with way and turn. Online EM (Cappe and Moulines 2009): each
match shares itself among the hypotheses by how well they foretold it; shares move the weights, and squared errors the
deviations. Distance sets the pace, not time: a robot that stands learns nothing.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.frontend.lidar.velocity_filter import VelocityFilter
from ngo_estimator.geometry.mode_search import Mixture
from ngo_estimator.geometry.planar_motion import (
    Array,
    arc_motion,
    arc_velocity,
    between,
    compose,
    inverted,
    propagated,
    wrap,
)

TIGHT, LOOSE, LAST, VELOCITY, NONE, ANY = range(6)

_KNOWN = np.zeros((3, 3))
"""Covariance of what is measured exactly."""


class MotionMixture:
    """Hypotheses: wheels that are good, wheels that are poor, the last displacement, the last velocity, none,
    anything.

    Attributes:
        weights: of the hypotheses ``(6,)``, as learned.
        steps, deviations: mean motions ``(6, 3)`` as foretold last, and their deviations ``(6, 2)`` (m, rad).
        calibration: expected motions are those that the wheels count ``(3,)`` times this ``(3, 3)``, by running least
            squares: scales of way and turn, yaw of the scanner against its mounting, lever arm between both.
        filter: of pose and velocity.
    """

    def __init__(self, config: MixtureConfig) -> None:
        self._config = config
        self.weights = np.array(config.first_weights)
        self._factors = np.array(config.first_factors)[:, None].repeat(2, axis=1)  # of positions, of headings
        self._squares, self._least = self._factors**2, np.array(config.least_factors)
        self.steps = np.zeros((6, 3))
        self._usable = np.zeros(6, np.bool_)
        self._base = self.deviations = np.ones((6, 2))
        self._gap = self._last_gap = 1.0
        self._yaw = 0.0
        self.filter = VelocityFilter()
        self._foretold = {k: self.filter.predicted(0.0, np.zeros(3), 1.0, np.zeros(2)) for k in (LAST, VELOCITY)}
        self._counted: Array | None = None
        self._motions = np.diag((config.certain_m, config.certain_m, config.certain_rad))  # sums of squares, by wheels
        self._products, self.calibration = self._motions.copy(), np.eye(3)

    @property
    def usable(self) -> list[int]:
        """The hypotheses that can be formed."""
        return [int(k) for k in np.flatnonzero(self._usable)]

    def foretell(self, yaw: float, by_wheels: Array | None, counted: Array | None, gap: float) -> None:
        """Form the hypotheses of the next motion from a pose of heading ``yaw``; ``by_wheels`` ``(3,)`` is what the
        wheels tell of it, and ``counted`` ``(3,)`` the same without calibration; None where they are silent.

        ``gap`` is the time since the last scan in usual periods: what the wheels did not count is as much longer.
        """
        heard = by_wheels is not None
        self._usable[:] = (self.weights > 0.0) & np.array((heard, heard, True, True, True, True))
        self.steps[:] = 0.0
        self._last_gap, self._gap = self._gap, min(max(gap, 0.05), self._config.most_gap)
        self.steps[LAST] = self.steps[ANY] = arc_motion(self.filter.velocity, self._last_gap)
        self.steps[VELOCITY] = arc_motion(self.filter.velocity, self._gap)
        self._counted = counted
        if by_wheels is not None:
            self.steps[TIGHT] = self.steps[LOOSE] = self.steps[ANY] = by_wheels
        c = self._config
        grow = c.still_m, c.way_share, c.turn_m, math.radians(c.still_deg), c.turn_share, c.way_rad
        self._base, self.deviations = _grown(self.steps, self._factors, max(self._gap, 1.0), grow, c.anything)
        self._yaw = yaw
        for k in (LAST, VELOCITY):
            self._expect(k, 0.0)

    def _expect(self, hypothesis: int, share: float) -> None:
        """Where the velocity leads, which has become anything with a ``share`` of the probability."""
        periods = self._last_gap if hypothesis == LAST else self._gap
        changes = np.sqrt(self.deviations[hypothesis] ** 2 + share * self.deviations[ANY] ** 2)
        self._foretold[hypothesis] = self.filter.predicted(self._yaw, self.steps[hypothesis], periods, changes)

    def prior(self, pose: Array, covariance: Array, walls: Array | None, least: tuple[float, float]) -> Mixture:
        """The mixture of poses after ``pose`` ``(3,)`` with its covariance ``(3, 3)``, as ``walls`` ``(3, 3)`` would
        measure them; no deviation is below ``least`` (m, rad)."""
        joint = self._foretold[LAST][0], self._foretold[VELOCITY][0]
        walls = _KNOWN if walls is None else walls
        means = _formed(pose, self.steps, self._usable, self.deviations, covariance, *joint, walls, self.weights, least)
        return Mixture(*means)

    @property
    def heaviest(self) -> int:
        """The hypothesis of the largest weight, of those that can be formed."""
        return int(np.where(self._usable, self.weights, 0.0).argmax())

    @property
    def trusts_wheels(self) -> bool:
        """Whether wheels are the heaviest: without them nothing but the scan tells how far the robot went."""
        return self.heaviest in (TIGHT, LOOSE)

    def likeliest(self, pose: Array, mixture: Mixture) -> int:
        """The hypothesis that is likeliest at a pose ``(3,)`` under the ``mixture`` as walls measure it.

        Where they measure little, a velocity that goes on is as unsure as a change of it is likely.
        """
        logs = mixture.logs(pose)
        result = int(np.flatnonzero(self._usable)[int(logs.argmax())])
        if result in (LAST, VELOCITY):
            shares = np.exp(logs - logs.max())
            self._expect(result, float(shares[-1] / shares.sum()))
        return result

    def expected(self, hypothesis: int, pose: Array, covariance: Array) -> tuple[Array, Array]:
        """The pose ``(3,)`` that a hypothesis foretells after ``pose`` of ``covariance``, and its covariance."""
        repeated = self._config.repeated if hypothesis in (TIGHT, LOOSE) else 1.0
        mean, spread = _expected(pose, covariance, self.steps[hypothesis], self.deviations[hypothesis], repeated)
        if hypothesis in (LAST, VELOCITY):
            spread = self._foretold[hypothesis][0][:3, :3].copy()
        return mean, spread

    def step_covariance(self, hypothesis: int) -> Array:
        """Covariance ``(3, 3)`` of a hypothesis' motion; errors of wheels repeat from step to step."""
        repeated = self._config.repeated if hypothesis in (TIGHT, LOOSE) else 1.0
        result: Array = _diagonal(self.deviations[hypothesis], repeated)
        return result

    def foretold(self, pose: Array, covariance: Array) -> tuple[Array, Array]:
        """The pose ``(3,)`` after one of ``covariance`` ``(3, 3)`` by the likeliest hypothesis, with the covariance of
        all."""
        best, total = compose(pose, self.steps[self.heaviest]), np.zeros((3, 3))
        weights = np.where(self._usable, self.weights, 0.0)
        for k in map(int, np.flatnonzero(self._usable)):
            mean, spread = self.expected(k, pose, covariance)
            off = mean - best
            off[2] = wrap(float(off[2]))
            total += weights[k] / weights.sum() * (spread + np.outer(off, off))
        return best, total

    def take(self, hypothesis: int, before: Array, pose: Array, covariance: Array, walls: Array | None) -> None:
        """The robot went from ``before`` to ``pose``, both ``(3,)``, as a hypothesis has it; ``walls`` ``(3, 3)`` is
        what a match says of the step alone."""
        if hypothesis in (LAST, VELOCITY):
            change = pose - compose(before, self.steps[hypothesis])
            self.filter.correct(self._foretold[hypothesis], change, covariance)
            return
        step = between(before, pose)
        motion = self.step_covariance(hypothesis)
        if walls is not None:
            motion = inverted(inverted(motion) + inverted(walls))
        self.filter.begin(arc_velocity(step, self._gap), motion / self._gap**2, covariance)

    def learn(self, step: Array, walls: Array) -> None:
        """Take the motion ``(3,)`` that a match found, with the covariance ``(3, 3)`` that walls alone leave it."""
        c = self._config
        numbers = c.learn_rate, c.learn_way, c.least_weight, c.most_factor
        foretold = self.steps, self._usable, self._base, self.deviations
        known = self.filter.joint, (self._last_gap, self._gap)
        share, way = _learned(
            *foretold, self.weights, self._squares, self._factors, self._least, step, walls, *known, numbers
        )
        counted, sums = self._counted, (self._motions, self._products)
        if share > 0.0 and counted is not None and abs(counted[2]) < c.learn_way and way < 2.0 * c.learn_way:
            self.calibration = _calibrated(*sums, counted, step, share, c.remembered_m)


@njit(cache=True)
def _calibrated(
    squares: Array, products: Array, motion: Array, found: Array, share: float, remembered_m: float
) -> Array:
    """Take a motion ``(3,)`` into sums of squares and products ``(3, 3)``; the matrix ``(3, 3)`` that they make."""
    way = math.hypot(motion[0], motion[1])
    keep = 1.0 - share * min(0.1, way / remembered_m)
    share /= way + abs(motion[2]) + 1e-3  # errors grow with the root of the way
    squares[:] = keep * squares + share * np.outer(motion, motion)
    products[:] = keep * products + share * np.outer(motion, found)
    return np.ascontiguousarray(np.linalg.solve(squares, products))


@njit(cache=True)
def _grown(
    steps: Array, factors: Array, longer: float, grow: tuple[float, float, float, float, float, float],
    anything: tuple[float, float],
) -> tuple[Array, Array]:  # fmt: skip
    """Deviations ``(6, 2)`` (m, rad) of steps ``(6, 3)``, before factors and with them."""
    still_m, way_share, turn_m, still_rad, turn_share, way_rad = grow
    base = np.empty((6, 2))
    for k in range(6):
        way = math.hypot(steps[k, 0], steps[k, 1]) if k not in (NONE, ANY) else 0.0
        turn = abs(steps[k, 2]) if k not in (NONE, ANY) else 0.0
        base[k, 0] = still_m + way_share * way + turn_m * turn
        base[k, 1] = still_rad + turn_share * turn + way_rad * way
    base[ANY, 0], base[ANY, 1] = anything
    deviations = factors * base
    for k in (LAST, VELOCITY, NONE, ANY):
        deviations[k] *= longer
    return base, deviations


@njit(cache=True)
def _expected(
    pose: Array, covariance: Array, step: Array, deviations: Array, repeated: float
) -> tuple[Array, Array]:  # fmt: skip
    mean = compose(pose, step)
    return mean, propagated(covariance, mean, step, _diagonal(deviations, repeated))


@njit(cache=True)
def _diagonal(deviations: Array, repeated: float) -> Array:
    result = np.zeros((3, 3))
    result[0, 0] = result[1, 1] = repeated * deviations[0] ** 2
    result[2, 2] = repeated * deviations[1] ** 2
    return result


@njit(cache=True)
def _learned(
    steps: Array, usable: NDArray[np.bool_], base: Array, deviations: Array, weights: Array, squares: Array,
    factors: Array, least: Array, step: Array, walls: Array, joint: Array, gaps: tuple[float, float],
    numbers: tuple[float, float, float, float],
) -> tuple[float, float]:  # fmt: skip
    """Move weights ``(6,)``, ``squares`` and ``factors`` ``(6, 2)`` by a match; the wheels' share in it, and the way.

    ``joint`` ``(6, 6)`` is what the last match left open.
    """
    learn_rate, learn_way, least_weight, most_factor = numbers
    by_wheels = steps[TIGHT] if usable[TIGHT] else step
    way = max(math.hypot(step[0], step[1]), math.hypot(by_wheels[0], by_wheels[1]))
    rate = learn_rate * min(1.0, way / learn_way + max(abs(step[2]), abs(by_wheels[2])) / learn_way)
    if rate <= 0.0:
        return 0.0, way
    variance = np.empty((6, 2))
    variance[:, 0], variance[:, 1] = 0.5 * (walls[0, 0] + walls[1, 1]), walls[2, 2]
    for k, periods in ((LAST, gaps[0]), (VELOCITY, gaps[1])):
        variance[k, 0] += 0.5 * (joint[3, 3] + joint[4, 4]) * periods**2
        variance[k, 1] += joint[5, 5] * periods**2
    errors, shares = _shared(steps, step, deviations, variance, weights, usable)
    held = (weights * usable).sum()
    for k in range(6):
        if usable[k]:
            weights[k] += rate * (held * shares[k] - weights[k])
    weights[:] = np.where(weights > 0.0, np.maximum(weights, least_weight), 0.0)
    weights /= weights.sum()
    for k in range(6):
        for i in range(2):
            # Of a posterior: what the match leaves open is as likely as it was foretold.
            known = deviations[k, i] ** 2
            part = known / (known + variance[k, i])
            shrunk = errors[k, i] * part**2 + part * variance[k, i]
            squares[k, i] += rate * shares[k] * (min(shrunk / base[k, i] ** 2, most_factor**2) - squares[k, i])
            factors[k, i] = min(max(math.sqrt(squares[k, i]), least[k]), most_factor)
    return shares[TIGHT] + shares[LOOSE], way


@njit(cache=True)
def _shared(
    steps: Array, found: Array, deviations: Array, variance: Array, weights: Array, usable: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Squared errors ``(n, 2)`` of hypotheses against the motion that was ``found``, and shares ``(n,)`` in it."""
    errors, logs = np.empty((len(steps), 2)), np.full(len(steps), -np.inf)
    for k in range(len(steps)):
        off = between(steps[k], found)
        errors[k] = 0.5 * (off[0] ** 2 + off[1] ** 2), off[2] ** 2
        if usable[k]:
            spread = deviations[k] ** 2 + variance[k]
            logs[k] = math.log(weights[k]) - math.log(spread[0]) - 0.5 * math.log(spread[1])
            logs[k] -= errors[k, 0] / spread[0] + 0.5 * errors[k, 1] / spread[1]
    shares = np.exp(logs - logs.max())
    return errors, shares / shares.sum()


@njit(cache=True)
def _formed(
    pose: Array, steps: Array, usable: NDArray[np.bool_], own: Array, covariance: Array, last: Array, velocity: Array,
    walls: Array, weights: Array, least: tuple[float, float],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Means, deviations and logarithms of weights of the mixture after ``pose`` ``(3,)``."""
    n = int(usable.sum())
    means, deviations, logs = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    peak = -2.0 * math.log(least[0]) - math.log(least[1]) if min(least) > 0.0 else 0.0
    i = 0
    for k in range(len(steps)):
        if usable[k]:
            means[i] = compose(pose, steps[k])
            spread = last if k == LAST else velocity if k == VELOCITY else covariance
            more_m, more_rad = (0.0, 0.0) if k in (LAST, VELOCITY) else (own[k, 0], own[k, 1])
            position = 0.5 * (spread[0, 0] + spread[1, 1] + walls[0, 0] + walls[1, 1])
            deviations[i, 0] = math.sqrt(more_m**2 + position + least[0] ** 2)
            deviations[i, 1] = math.sqrt(more_rad**2 + spread[2, 2] + walls[2, 2] + least[1] ** 2)
            logs[i] = weights[k]
            i += 1
    total = logs.sum()
    for i in range(n):
        logs[i] = math.log(logs[i] / total) - 2.0 * math.log(deviations[i, 0]) - math.log(deviations[i, 1]) - peak
    return means, deviations, logs
