"""Where a robot may be after its last scan: hypotheses of its motion, whose weights and deviations matches teach.

Each hypothesis has a mean motion and deviations that grow with way and turn. Online EM (Cappe and Moulines 2009): each
match shares itself among the hypotheses by how well they foretold it; shares move the weights, and squared errors the
deviations. Distance sets the pace, not time: a robot that stands learns nothing.
"""

import math

import numpy as np

from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.geometry.mode_search import Mixture
from ngo_estimator.geometry.planar_motion import Array, between, compose, wrap


class WheelCalibration:
    """What a motion that the wheels count is worth: a matrix, by running least squares.

    It holds the scales of way and turn, the yaw of the scanner against its mounting, and the lever arm between both.
    """

    def __init__(self, config: MixtureConfig) -> None:
        self._config = config
        first = np.diag((config.certain_m, config.certain_m, config.certain_rad)) ** 2
        self._squares, self._products = first, first.copy()
        self._matrix = np.eye(3)

    @property
    def matrix(self) -> Array:
        """Expected motions are wheels' motions ``(3,)`` times this ``(3, 3)``."""
        return self._matrix

    def learn(self, motion: Array, found: Array, share: float) -> None:
        """Take a motion ``(3,)`` of the wheels and what a match found; the ``share`` of it that is theirs counts."""
        keep = 1.0 - share * min(0.1, math.hypot(motion[0], motion[1]) / self._config.remembered_m)
        self._squares = keep * self._squares + share * np.outer(motion, motion)
        self._products = keep * self._products + share * np.outer(motion, found)
        self._matrix = np.linalg.solve(self._squares, self._products)


TIGHT, LOOSE, LAST, NONE, ANY = range(5)


class MotionMixture:
    """Hypotheses: wheels that are good, wheels that are poor, the last displacement, none, anything."""

    def __init__(self, config: MixtureConfig) -> None:
        self._config = config
        self._weights = np.array(config.first_weights)
        self._factors = np.array(config.first_factors)[:, None].repeat(2, axis=1)  # of positions, of headings
        self._squares = self._factors**2
        self._steps = np.zeros((5, 3))
        self._usable = np.zeros(5, np.bool_)
        self._base = self._deviations = np.ones((5, 2))
        self._gap = 1.0
        self._last = np.zeros(3)
        self._raw: Array | None = None
        self.calibration = WheelCalibration(config)

    @property
    def weights(self) -> Array:
        """Weights ``(5,)`` of the hypotheses, as learned."""
        return self._weights

    @property
    def steps(self) -> Array:
        """Mean motions ``(5, 3)`` as foretold last."""
        return self._steps

    def foretell(self, by_wheels: Array | None, counted: Array | None, gap: float) -> None:
        """Form the hypotheses of the next motion; ``by_wheels`` ``(3,)`` is what the wheels tell of it, and
        ``counted`` ``(3,)`` the same without calibration; None where they are silent.

        ``gap`` is the time since the last scan in usual periods: what the wheels did not count is as much longer.
        """
        self._usable[:] = by_wheels is not None, by_wheels is not None, True, True, True
        self._steps[:] = 0.0
        self._steps[LAST] = self._steps[ANY] = self._last
        self._raw = counted
        if by_wheels is not None:
            self._steps[TIGHT] = self._steps[LOOSE] = self._steps[ANY] = by_wheels
        self._gap = min(max(gap, 1.0), self._config.most_gap)
        self._base = self._unscaled()
        self._deviations = self._factors * self._base
        self._deviations[[LAST, NONE]] *= self._gap
        self._deviations[ANY] = np.array(self._config.anything) * self._gap

    def _unscaled(self) -> Array:
        """Deviations ``(5, 2)`` (m, rad) before factors."""
        c = self._config
        way, turn = np.hypot(self._steps[:, 0], self._steps[:, 1]), np.abs(self._steps[:, 2])
        way[[NONE, ANY]], turn[[NONE, ANY]] = 0.0, 0.0
        position = c.still_m + c.way_share * way + c.turn_m * turn
        heading = math.radians(c.still_deg) + c.turn_share * turn + c.way_rad * way
        return np.stack((position, heading), axis=-1)

    def prior(self, pose: Array, covariance: Array, least: tuple[float, float]) -> Mixture:
        """The mixture of poses after ``pose`` ``(3,)`` with its covariance ``(3, 3)``; no deviation is below ``least``
        (m, rad)."""
        usable = self._usable
        own = np.array((0.5 * (covariance[0, 0] + covariance[1, 1]), covariance[2, 2]))
        deviations = np.sqrt(self._deviations[usable] ** 2 + own + np.square(least))
        weights = self._weights[usable] / self._weights[usable].sum()
        logs = np.log(weights) - 2.0 * np.log(deviations[:, 0]) - np.log(deviations[:, 1])
        peak = -2.0 * math.log(least[0]) - math.log(least[1]) if min(least) > 0.0 else 0.0
        means = np.array([compose(pose, step) for step in self._steps[usable]])
        return Mixture(means, deviations, logs - peak)

    @property
    def heaviest(self) -> int:
        """The hypothesis whose density is highest."""
        density = self._weights / (self._deviations[:, 0] ** 2 * self._deviations[:, 1])
        return int(np.where(self._usable, density, 0.0).argmax())

    def likeliest(self, pose: Array, mixture: Mixture) -> int:
        """The hypothesis that is likeliest at a pose ``(3,)``."""
        return int(np.flatnonzero(self._usable)[int(mixture.logs(pose).argmax())])

    def step_covariance(self, hypothesis: int) -> Array:
        """Covariance ``(3, 3)`` of a hypothesis' motion, whose errors repeat from step to step."""
        position, heading = math.sqrt(self._config.repeated) * self._deviations[hypothesis]
        return np.diag((position**2, position**2, heading**2))

    def learn(self, step: Array, variance: Array) -> None:
        """Take the motion ``(3,)`` that a match found, with the variances ``(2,)`` of its position and heading."""
        c, usable = self._config, self._usable
        self._last = step
        way, turn = math.hypot(step[0], step[1]), abs(float(step[2]))
        by_wheels = self._steps[TIGHT] if usable[TIGHT] else step
        way, turn = max(way, math.hypot(by_wheels[0], by_wheels[1])), max(turn, abs(float(by_wheels[2])))
        rate = c.learn_rate * min(1.0, way / c.learn_m + turn / c.learn_rad)
        if rate <= 0.0:
            return
        off = np.array([between(mean, step) for mean in self._steps])
        errors = np.stack(
            (0.5 * (off[:, 0] ** 2 + off[:, 1] ** 2), np.array([wrap(float(e)) ** 2 for e in off[:, 2]])), axis=-1
        )
        spread = self._deviations**2 + variance
        logs = np.log(self._weights) - np.log(spread[:, 0]) - 0.5 * np.log(spread[:, 1])
        logs -= errors[:, 0] / spread[:, 0] + 0.5 * errors[:, 1] / spread[:, 1]
        logs[~usable] = -np.inf
        shares = np.exp(logs - logs.max())
        shares /= shares.sum()
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
