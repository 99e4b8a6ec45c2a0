"""How a robot's velocity goes on, learned from the motions that walls tell.

Not in the paper. A robot that stops turning drives on, and one that turns slows down. Where a corridor tells the turn
and hides the way, such habits say how far it came. The model is an autoregression of first order, by recursive least
squares with forgetting.
"""

import math
from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry.planar_motion import Array

_MEMORY = 200
"""Steps, over which the model is learned."""

_FIRST_STEPS = 10
"""Steps before which all is a guess."""

_FEWEST = 50
"""Steps before which it is not used."""

_GAIN = 0.05
"""Nats a step, by which it must tell the next velocity better than a constant one does."""

_LONGEST = 3.0
"""Mean steps, after which it is not known what follows."""

_RIDGE = 1e-3
"""Of the least squares: without motion nothing changes."""

_WIDER = 1.5
"""Factor on its deviations: it was learned where walls tell the motion, and is used where they do not."""

_FIRST_DEVIATION = 0.1
"""Of a change in one second (m/s, m/s, rad/s), before it was measured."""

_LEAST = 1e-8 * np.eye(3)
"""Squared deviations below which all is exact."""

_FARTHEST = 5.0
"""Deviations, from which on an error counts less: a wrong registration is no motion of the robot."""


@dataclass(frozen=True, eq=False)
class NextVelocity:
    """The next velocity: ``mean`` ``(3,)``, its derivative by the one before, its ``covariance``, both ``(3, 3)``."""

    mean: Array
    by_velocity: Array
    covariance: Array


class MotionModel:
    """A linear model of the velocity's change, seen from the side that the robot turns to.

    Velocities are ``(3,)``, along the robot's axes (m/s, m/s, rad/s).
    """

    def __init__(self) -> None:
        self._squares, self._products = np.zeros((4, 4)), np.zeros((4, 3))
        self._weights: Array = np.zeros((4, 3))  # of velocity and one, on the change in one second
        self._errors: Array = _FIRST_DEVIATION**2 * np.eye(3)  # squared: of the model
        self._changes: Array = _FIRST_DEVIATION**2 * np.eye(3)  # of a constant velocity
        self._least: Array = np.zeros(3)  # of the velocities that walls told, and the largest
        self._largest: Array = np.zeros(3)
        self._gain, self._steps, self._period_s = 0.0, 0, 0.0
        self._last: Array | None = None

    def after(self, velocity: Array, elapsed: float) -> NextVelocity | None:
        """The velocity ``elapsed`` seconds later, within what was seen before.

        None where the model is not known to tell more than a constant velocity, or would grow without limit.
        """
        if self._steps < _FEWEST or self._gain < _GAIN or elapsed > _LONGEST * self._period_s:
            return None
        side = _side(velocity)
        by_velocity = np.eye(3) + elapsed * side[:, None] * self._weights[:3].T * side
        if float(np.abs(np.linalg.eigvals(by_velocity)).max()) > 1.0:
            return None
        mean = side * velocity + elapsed * (np.append(side * velocity, 1.0) @ self._weights)
        mean = side * np.clip(mean, self._least, self._largest)
        return NextVelocity(mean, by_velocity, _WIDER**2 * elapsed * self._errors * np.outer(side, side))

    def observe(self, velocity: Array, elapsed: float) -> None:
        """Walls told a step of this velocity, ``elapsed`` seconds after the one before."""
        last, self._last = self._last, velocity
        if last is None:
            return
        # Changes wander: their squares grow with the time.
        side, root_s = _side(last), math.sqrt(elapsed)
        given = root_s * np.append(side * last, 1.0)
        change = side * (velocity - last) / root_s
        error = change - given @ self._weights
        unlike, usual = _squared(change, self._changes), _squared(error, self._errors)
        if usual <= _FARTHEST**2:
            self._least = np.minimum(self._least, side * velocity)
            self._largest = np.maximum(self._largest, side * velocity)
        self._steps += 1
        self._period_s += (elapsed - self._period_s) / min(self._steps, _MEMORY)
        weight = 1.0 / min(self._steps + 1, _MEMORY)
        if self._steps > _FIRST_STEPS:
            gain = _nats(unlike, self._changes) - _nats(usual, self._errors)
            self._gain += weight * (gain - self._gain)
        self._changes = self._changes + weight * (_counted(unlike) * np.outer(change, change) - self._changes)
        self._errors = self._errors + weight * (_counted(usual) * np.outer(error, error) - self._errors)
        kept, counted = 1.0 - 1.0 / _MEMORY, _counted(usual)
        self._squares = kept * self._squares + counted * np.outer(given, given)
        self._products = kept * self._products + counted * np.outer(given, change)
        weights: Array = np.linalg.solve(self._squares + _RIDGE * np.eye(4), self._products).astype(np.float64)
        self._weights = weights

    def interrupt(self) -> None:
        """The walls do not tell the newest step."""
        self._last = None


def _side(velocity: Array) -> Array:
    """Signs ``(3,)`` that make a turn to the right one to the left."""
    return np.array((1.0, -1.0, -1.0)) if velocity[2] < 0.0 else np.ones(3)


def _squared(error: Array, squares: Array) -> float:
    """Squared deviations of an error ``(3,)``."""
    return float(error @ np.linalg.solve(squares + _LEAST, error))


def _nats(squared: float, squares: Array) -> float:
    """How unlikely an error of so many squared deviations is, up to a constant."""
    return 0.5 * (min(squared, _FARTHEST**2) + float(np.linalg.slogdet(squares + _LEAST)[1]))


def _counted(squared: float) -> float:
    """How much an error of so many squared deviations counts."""
    return min(1.0, _FARTHEST**2 / max(squared, 1e-12))
