"""The time by which wheel odometry and scans disagree, from the turns that both measure.

A scan whose stamp is right sees the turn that the wheels report between the same stamps. For every lag of a grid the
estimator sums the squared differences between both turns; the lag with the least sum explains the stamps. The wheels'
own squares are means over one of their periods: interpolation between two noisy readings shrinks them, and lags that
fall between readings would look better than the right one. Sums for lags and pairs of lags are kept.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from ngo_estimator.geometry.planar_motion import Array

_PERIODS = 33
"""The wheels' period is the median of so many readings, less one."""


@dataclass(frozen=True)
class WheelLagConfig:
    """How the lag is estimated, in s: lags up to ``largest_s`` either way in steps of ``step_s``.

    Turns that differ by more than ``largest_rad`` at every lag tell nothing: slip, frozen wheels and bad matches are no
    lag. Neither do intervals over ``longest_s``, nor turns below ``least_turn_rad``. After ``fewest`` turns a lag
    replaces the present one where its squares are smaller by ``significance`` deviations of the difference, as the
    turns themselves scatter. Old turns fade with a half-life of ``half_life`` turns.
    """

    largest_s: float = 0.4
    step_s: float = 0.02
    largest_rad: float = 0.06
    longest_s: float = 0.5
    least_turn_rad: float = 0.01
    fewest: int = 40
    significance: float = 4.0
    half_life: int = 2000

    def __post_init__(self) -> None:
        if not 0.0 < self.step_s < self.largest_s < math.inf or self.fewest < 1 or self.half_life < 1:
            raise ValueError(
                f"step_s, largest_s, fewest, half_life are {self.step_s}, {self.largest_s}, {self.fewest}, "
                f"{self.half_life}; expected 0 < step_s < largest_s, and at least 1 turn"
            )
        if not (self.largest_rad > 0.0 and self.longest_s > 0.0 and self.significance > 0.0):
            raise ValueError(
                f"largest_rad, longest_s, significance are {self.largest_rad}, {self.longest_s}, {self.significance}; "
                "expected positive numbers"
            )


class WheelLag:
    """Running estimate of the lag: ``lag_s`` is how much older scans are than their stamps, by the wheels' clock.

    It is 0 until another value is significant.
    """

    def __init__(self, config: WheelLagConfig | None = None) -> None:
        self.config = config or WheelLagConfig()
        count = round(self.config.largest_s / self.config.step_s)
        self._lags = np.arange(-count, count + 1) * self.config.step_s
        self._sums = np.zeros(len(self._lags))
        self._products = np.zeros((len(self._lags), len(self._lags)))
        self._weight = 0.0
        self._waiting: deque[tuple[float, float, float]] = deque(maxlen=64)
        self.lag_s = 0.0

    def observe(self, start_s: float, end_s: float, turn: float) -> None:
        """Take a turn (rad) that the scans measured between two stamps."""
        if not all(map(math.isfinite, (start_s, end_s, turn))):
            raise ValueError(f"start_s, end_s, turn are {start_s}, {end_s}, {turn}; expected finite numbers")
        if 0.0 < end_s - start_s <= self.config.longest_s:
            self._waiting.append((start_s, end_s, turn))

    def update(self, stamps_s: Array, yaws: Array) -> bool:
        """Compare the waiting turns with the wheels' unwrapped yaws ``(n,)`` at stamps ``(n,)``; True for a new lag."""
        taken = False
        if not self._waiting or len(stamps_s) < 2:
            return False
        lags, mean = self._around(min(float(np.median(np.diff(stamps_s[-_PERIODS:]))), self.config.largest_s))
        while self._waiting and self._waiting[0][1] - lags[0] <= stamps_s[-1]:
            start_s, end_s, turn = self._waiting.popleft()
            if start_s - lags[-1] < stamps_s[0]:
                continue
            around = np.interp(end_s - lags, stamps_s, yaws) - np.interp(start_s - lags, stamps_s, yaws)
            beside = len(mean) // 2
            turns = around[beside : len(around) - beside]
            if max(abs(turn), float(np.abs(turns).max())) < self.config.least_turn_rad:
                continue
            fade = 0.5 ** (1.0 / self.config.half_life)
            if float(np.abs(turns - turn).min()) > self.config.largest_rad:
                continue
            squares = turn * turn - 2.0 * turn * turns + np.convolve(around**2, mean, "valid")
            self._sums = fade * self._sums + squares
            self._products = fade * self._products + np.outer(squares, squares)
            self._weight = fade * self._weight + 1.0
            taken = True
        return taken and self._decide()

    def _around(self, period_s: float) -> tuple[Array, Array]:
        """The lags and half a period beside them, and the weights of a mean over one period."""
        beside = round(0.5 * period_s / self.config.step_s)
        lags = np.arange(-beside, len(self._lags) + beside) * self.config.step_s + self._lags[0]
        weights = np.ones(2 * beside + 1)
        if beside:
            weights[[0, -1]] = 0.5
        return lags, weights / weights.sum()

    def _decide(self) -> bool:
        best = int(np.argmin(self._sums))
        if self._weight < self.config.fewest or not 0 < best < len(self._lags) - 1:
            return False
        before, least, after = self._sums[best - 1 : best + 2]
        bend = before - 2.0 * least + after
        lag = self._lags[best] + (0.5 * (before - after) / bend * self.config.step_s if bend > 0.0 else 0.0)
        if abs(lag - self.lag_s) < 0.25 * self.config.step_s:
            return False
        present = int(np.argmin(np.abs(self._lags - self.lag_s)))
        products = self._products[np.ix_((present, best), (present, best))]
        variance = products[0, 0] + products[1, 1] - 2.0 * products[0, 1]
        gain = self._sums[present] - least
        if present != best and gain < self.config.significance * math.sqrt(max(variance, 0.0)):
            return False
        self.lag_s = float(lag)
        return True
