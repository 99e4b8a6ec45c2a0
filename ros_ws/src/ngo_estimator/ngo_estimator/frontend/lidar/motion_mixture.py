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


class WheelCalibration:
    """What a motion that the wheels count is worth: a matrix, by running least squares.

    It holds the scales of way and turn, the yaw of the scanner against its mounting, and the lever arm between both.
    """

    def __init__(self, config: MixtureConfig) -> None:
        self._config = config
        first = np.diag((config.certain_m, config.certain_m, config.certain_rad))
        self._squares, self._products = first, first.copy()
        self._matrix = np.eye(3)

    @property
    def matrix(self) -> Array:
        """Expected motions are wheels' motions ``(3,)`` times this ``(3, 3)``."""
        return self._matrix

    def learn(self, motion: Array, found: Array, share: float) -> None:
        """Take a motion ``(3,)`` of the wheels and what a match found; the ``share`` of it that is theirs counts."""
        way = math.hypot(motion[0], motion[1])
        keep = 1.0 - share * min(0.1, way / self._config.remembered_m)
        share /= way + abs(float(motion[2])) + 1e-3  # errors grow with the root of the way
        self._squares = keep * self._squares + share * np.outer(motion, motion)
        self._products = keep * self._products + share * np.outer(motion, found)
        self._matrix = np.linalg.solve(self._squares, self._products)


TIGHT, LOOSE, LAST, VELOCITY, NONE, ANY = range(6)


class MotionMixture:
    """Hypotheses: wheels that are good, wheels that are poor, the last displacement, the last velocity, none,
    anything."""

    def __init__(self, config: MixtureConfig) -> None:
        self._config = config
        self._weights = np.array(config.first_weights)
        self._factors = np.array(config.first_factors)[:, None].repeat(2, axis=1)  # of positions, of headings
        self._squares = self._factors**2
        self._steps = np.zeros((6, 3))
        self._usable = np.zeros(6, np.bool_)
        self._base = self._deviations = np.ones((6, 2))
        self._gap = 1.0
        self.filter = VelocityFilter()
        self._foretold = {k: self.filter.predicted(0.0, np.zeros(3), 1.0, np.zeros(2)) for k in (LAST, VELOCITY)}
        self._last_gap = 1.0
        self._raw: Array | None = None
        self.calibration = WheelCalibration(config)

    @property
    def weights(self) -> Array:
        """Weights ``(6,)`` of the hypotheses, as learned."""
        return self._weights

    @property
    def steps(self) -> Array:
        """Mean motions ``(6, 3)`` as foretold last."""
        return self._steps

    @property
    def usable(self) -> list[int]:
        """The hypotheses that can be formed."""
        return [int(k) for k in np.flatnonzero(self._usable)]

    @property
    def deviations(self) -> Array:
        """Deviations ``(6, 2)`` of their motions (m, rad)."""
        return self._deviations

    def foretell(self, yaw: float, by_wheels: Array | None, counted: Array | None, gap: float) -> None:
        """Form the hypotheses of the next motion from a pose of heading ``yaw``; ``by_wheels`` ``(3,)`` is what the
        wheels tell of it, and ``counted`` ``(3,)`` the same without calibration; None where they are silent.

        ``gap`` is the time since the last scan in usual periods: what the wheels did not count is as much longer.
        """
        self._usable[:] = by_wheels is not None, by_wheels is not None, True, True, True, True
        self._steps[:] = 0.0
        self._last_gap, self._gap = self._gap, min(max(gap, 0.05), self._config.most_gap)
        self._steps[LAST] = self._steps[ANY] = arc_motion(self.filter.velocity, self._last_gap)
        self._steps[VELOCITY] = arc_motion(self.filter.velocity, self._gap)
        self._raw = counted
        if by_wheels is not None:
            self._steps[TIGHT] = self._steps[LOOSE] = self._steps[ANY] = by_wheels
        longer = max(self._gap, 1.0)
        self._base = self._unscaled()
        self._deviations = self._factors * self._base
        self._deviations[[LAST, VELOCITY, NONE]] *= longer
        self._deviations[ANY] = np.array(self._config.anything) * longer
        for k, periods in ((LAST, self._last_gap), (VELOCITY, self._gap)):
            self._foretold[k] = self.filter.predicted(yaw, self._steps[k], periods, self._deviations[k])

    def _unscaled(self) -> Array:
        """Deviations ``(6, 2)`` (m, rad) before factors."""
        c = self._config
        way, turn = np.hypot(self._steps[:, 0], self._steps[:, 1]), np.abs(self._steps[:, 2])
        way[[NONE, ANY]], turn[[NONE, ANY]] = 0.0, 0.0
        position = c.still_m + c.way_share * way + c.turn_m * turn
        heading = math.radians(c.still_deg) + c.turn_share * turn + c.way_rad * way
        return np.stack((position, heading), axis=-1)

    def prior(
        self, pose: Array, covariance: Array, walls: Array | None, least: tuple[float, float], share: float = 0.0
    ) -> Mixture:
        """The mixture of poses after ``pose`` ``(3,)`` with its covariance ``(3, 3)``, as ``walls`` ``(3, 3)`` would
        measure them; no deviation is below ``least`` (m, rad), and no weight below ``share``."""
        shared = np.array((0.5 * (covariance[0, 0] + covariance[1, 1]), covariance[2, 2]))
        variances = self._deviations**2 + shared
        for k in (LAST, VELOCITY):
            joint, _ = self._foretold[k]
            variances[k] = 0.5 * (joint[0, 0] + joint[1, 1]), joint[2, 2]
        if walls is not None:
            variances += (0.5 * (walls[0, 0] + walls[1, 1]), walls[2, 2])
        both = variances, self._weights
        return Mixture(*_formed(pose, self._steps, self._usable, *both, np.array(least), share))

    def _unknown(self) -> Array:
        """Variances ``(6, 2)`` of what the last match left open of the motion."""
        result = np.zeros((6, 2))
        known = self.filter.joint[3:, 3:]
        for k, periods in ((LAST, self._last_gap), (VELOCITY, self._gap)):
            result[k] = 0.5 * (known[0, 0] + known[1, 1]) * periods**2, known[2, 2] * periods**2
        return result

    @property
    def heaviest(self) -> int:
        """The hypothesis of the largest weight, of those that can be formed."""
        return int(np.where(self._usable, self._weights, 0.0).argmax())

    def likeliest(self, pose: Array, mixture: Mixture) -> int:
        """The hypothesis that is likeliest at a pose ``(3,)``."""
        return int(np.flatnonzero(self._usable)[int(mixture.logs(pose).argmax())])

    def pose_covariance(self, hypothesis: int, covariance: Array, mean: Array) -> Array:
        """Covariance ``(3, 3)`` of the ``mean`` ``(3,)`` that a hypothesis foretells from a pose of ``covariance``."""
        if hypothesis in (LAST, VELOCITY):
            result: Array = self._foretold[hypothesis][0][:3, :3].copy()
            return result
        return propagated(covariance, mean, self._steps[hypothesis], self.step_covariance(hypothesis))

    def step_covariance(self, hypothesis: int) -> Array:
        """Covariance ``(3, 3)`` of a hypothesis' motion; errors of wheels repeat from step to step."""
        position, heading = self._deviations[hypothesis] ** 2
        repeated = self._config.repeated if hypothesis in (TIGHT, LOOSE) else 1.0
        return repeated * np.diag((position, position, heading))

    def foretold(self, pose: Array, covariance: Array) -> tuple[Array, Array]:
        """The pose ``(3,)`` after one of ``covariance`` ``(3, 3)`` by the likeliest hypothesis, with the covariance of
        all."""
        means = [compose(pose, step) for step in self._steps]
        best, total = means[self.heaviest], np.zeros((3, 3))
        weights = np.where(self._usable, self._weights, 0.0)
        for k in map(int, np.flatnonzero(self._usable)):
            off = means[k] - best
            off[2] = wrap(float(off[2]))
            total += weights[k] / weights.sum() * (self.pose_covariance(k, covariance, means[k]) + np.outer(off, off))
        return best, total

    def take(self, hypothesis: int, before: Array, pose: Array, covariance: Array, walls: Array | None) -> None:
        """The robot went from ``before`` to ``pose``, both ``(3,)``, as a hypothesis has it; ``walls`` ``(3, 3)`` is
        what a match says of the step alone."""
        if hypothesis in (LAST, VELOCITY):
            change = pose - compose(before, self._steps[hypothesis])
            self.filter.correct(self._foretold[hypothesis], change, covariance)
            return
        step = between(before, pose)
        motion = self.step_covariance(hypothesis)
        if walls is not None:
            motion = inverted(inverted(motion) + inverted(walls))
        self.filter.begin(arc_velocity(step, self._gap), motion / self._gap**2, covariance)

    def learn(self, step: Array, walls: Array) -> None:
        """Take the motion ``(3,)`` that a match found, with the covariance ``(3, 3)`` that walls alone leave it."""
        c, usable = self._config, self._usable
        variance = np.array((0.5 * (walls[0, 0] + walls[1, 1]), walls[2, 2])) + self._unknown()
        way, turn = math.hypot(step[0], step[1]), abs(float(step[2]))
        by_wheels = self._steps[TIGHT] if usable[TIGHT] else step
        way, turn = max(way, math.hypot(by_wheels[0], by_wheels[1])), max(turn, abs(float(by_wheels[2])))
        rate = c.learn_rate * min(1.0, way / c.learn_m + turn / c.learn_rad)
        if rate <= 0.0:
            return
        errors, shares = _shared(self._steps, step, self._deviations, variance, self._weights, usable)
        if self._raw is not None and abs(self._raw[2]) < c.learn_rad and way < 2.0 * c.learn_m:
            self.calibration.learn(self._raw, step, float(shares[TIGHT] + shares[LOOSE]))
        held = self._weights[usable].sum()
        self._weights[usable] += rate * (held * shares[usable] - self._weights[usable])
        self._weights[:] = np.maximum(self._weights, c.least_weight)
        self._weights /= self._weights.sum()
        # Of a posterior: what the match leaves open is as likely as it was foretold.
        known = self._deviations**2
        left = known * variance / (known + variance)
        shrunk = errors * (known / (known + variance)) ** 2 + left
        part = rate * shares[:, None]
        self._squares += part * (np.minimum(shrunk / self._base**2, c.most_factor**2) - self._squares)
        least = np.array(c.least_factors)[:, None]
        self._factors = np.clip(np.sqrt(self._squares), least, c.most_factor)


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
    pose: Array, steps: Array, usable: NDArray[np.bool_], variances: Array, weights: Array, least: Array, share: float
) -> tuple[Array, Array, Array]:
    """Means, deviations and logarithms of weights of the mixture after ``pose`` ``(3,)``."""
    n = int(usable.sum())
    means, deviations, logs = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    peak = -2.0 * math.log(least[0]) - math.log(least[1]) if min(least) > 0.0 else 0.0
    i = 0
    for k in range(len(steps)):
        if usable[k]:
            means[i] = compose(pose, steps[k])
            deviations[i] = np.sqrt(variances[k] + least**2)
            logs[i] = max(weights[k], share)
            i += 1
    total = logs.sum()
    for i in range(n):
        logs[i] = math.log(logs[i] / total) - 2.0 * math.log(deviations[i, 0]) - math.log(deviations[i, 1]) - peak
    return means, deviations, logs
