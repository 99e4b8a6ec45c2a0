"""The time by which wheel odometry and scans disagree, from the turns that both measure.

A scan whose stamp is right sees the turn that the wheels report between the same stamps. For every lag of a grid the
estimator sums the squared differences between both turns; the lag with the least sum explains the stamps. One sum a
lag is kept.

Interpolation between two poses of the wheels averages their noise, most of it halfway, so that lags halfway between
stamps would win. Yaws are averaged over two periods of the wheels instead: then all lags average alike.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numba import njit

from ngo_estimator.geometry.planar_motion import Array

_WITHIN = (np.arange(8) + 0.5) / 4.0 - 1.0
"""Where the yaw is averaged, in periods of the wheels."""


@dataclass(frozen=True)
class WheelLagConfig:
    """How the lag is estimated, in s: lags up to ``largest_s`` either way in steps of ``step_s``. A difference of turns
    counts at most ``largest_rad``: slip and bad matches are no lag. Intervals over ``longest_s`` tell nothing, nor do
    turns below ``least_turn_rad``. After ``fewest`` turns a lag is significant where its sum is below that of the
    present one by ``significance`` mean squares. Old turns fade with a half-life of ``half_life`` turns."""

    largest_s: float = 0.4
    step_s: float = 0.02
    largest_rad: float = 0.06
    longest_s: float = 0.5
    least_turn_rad: float = 0.01
    fewest: int = 40
    significance: float = 30.0
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
        self._lags: Array = (np.arange(-count, count + 1) * self.config.step_s).astype(np.float64)
        self._sums = np.zeros(len(self._lags))
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
        while self._waiting and len(stamps_s) and self._waiting[0][1] + self.config.largest_s <= stamps_s[-1]:
            start_s, end_s, turn = self._waiting.popleft()
            if start_s - self.config.largest_s < stamps_s[0]:
                continue
            turns = _turns(start_s, end_s, self._lags, stamps_s, yaws, self.config.largest_s)
            if max(abs(turn), float(np.abs(turns).max())) < self.config.least_turn_rad:
                continue
            fade = 0.5 ** (1.0 / self.config.half_life)
            off = np.minimum(np.abs(turns - turn), self.config.largest_rad)
            self._sums = fade * self._sums + off**2
            self._weight = fade * self._weight + 1.0
            taken = True
        return taken and self._decide()

    def _decide(self) -> bool:
        best = int(np.argmin(self._sums))
        if self._weight < self.config.fewest or not 0 < best < len(self._lags) - 1:
            return False
        before, least, after = self._sums[best - 1 : best + 2]
        bend = before - 2.0 * least + after
        lag = self._lags[best] + (0.5 * (before - after) / bend * self.config.step_s if bend > 0.0 else 0.0)
        present = float(np.interp(self.lag_s, self._lags, self._sums))
        if abs(lag - self.lag_s) < 0.25 * self.config.step_s:
            return False
        if present - least < self.config.significance * least / self._weight:
            return False
        self.lag_s = float(lag)
        return True


@njit(cache=True)
def _turns(start_s: float, end_s: float, lags_s: Array, stamps_s: Array, yaws: Array, largest_s: float) -> Array:
    """The wheels' turn ``(lags,)`` between two times, for each lag."""
    return _averages(end_s, lags_s, stamps_s, yaws, largest_s) - _averages(start_s, lags_s, stamps_s, yaws, largest_s)


@njit(cache=True)
def _averages(at_s: float, lags_s: Array, stamps_s: Array, yaws: Array, largest_s: float) -> Array:
    """Yaws ``(lags,)`` around a time, for each lag: means over two periods of the stamps, of ``largest_s`` at most."""
    first = max(np.searchsorted(stamps_s, at_s - 2.0 * largest_s) - 1, 0)
    last = np.searchsorted(stamps_s, at_s + 2.0 * largest_s) + 1
    stamps_s, yaws = stamps_s[first:last].copy(), yaws[first:last].copy()
    period_s = 0.0
    if len(stamps_s) > 1:
        period_s = min(float(np.median(stamps_s[1:] - stamps_s[:-1])), largest_s)
    averages = np.empty(len(lags_s))
    for k in range(len(lags_s)):
        averages[k] = np.interp(at_s - lags_s[k] + period_s * _WITHIN, stamps_s, yaws).mean()
    return averages
