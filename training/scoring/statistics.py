"""Means over trajectories with bootstrap intervals, and paired comparisons of two estimators."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

RESAMPLES = 10_000
_SEED = 0
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """A mean, and the interval ``low`` to ``high`` that holds it with a confidence of 95 %."""

    mean: float
    low: float
    high: float

    def as_json(self) -> dict[str, object]:
        """``{mean, ci95: [low, high]}``."""
        return {"mean": self.mean, "ci95": [self.low, self.high]}


@dataclass(frozen=True)
class Comparison:
    """How far one estimator's errors are from another's on the same trajectories.

    ``difference``: mean of the differences of each trajectory. ``relative_percent``: difference of the two means in
    percent of the other's mean.
    """

    difference: Interval
    relative_percent: Interval

    def as_json(self) -> dict[str, object]:
        return {"difference": self.difference.as_json(), "relative_percent": self.relative_percent.as_json()}


def mean_interval(values: np.ndarray) -> Interval:
    """Mean of ``values`` ``(trajectories,)`` or ``(seeds, trajectories)``, its interval by resampling trajectories.

    Of several seeds, each trajectory counts with its mean over them: the interval is about other mazes, not about other
    trainings, whose spread the means of the single seeds show.
    """
    values = _by_trajectory(values)
    return _interval(float(values.mean()), _resampled_means(values))


def compare(values: np.ndarray, others: np.ndarray) -> Comparison:
    """Compare two estimators' errors on the same trajectories, shaped as in ``mean_interval``."""
    values, others = _by_trajectory(values), _by_trajectory(others)
    if len(values) != len(others):
        raise ValueError(f"{len(values)} and {len(others)} trajectories are given; expected the same ones")
    means, other_means = _resampled_means(values), _resampled_means(others)
    if other_means.min() <= 0.0:
        raise ValueError("the errors to compare with are zero; expected positive ones")
    ratio = float(values.mean() / others.mean())
    return Comparison(
        _interval(float(values.mean() - others.mean()), means - other_means),
        _interval(100.0 * (ratio - 1.0), 100.0 * (means / other_means - 1.0)),
    )


def _by_trajectory(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim not in (1, 2) or values.shape[-1] < 2:
        raise ValueError(
            f"values are of shape {values.shape}; expected (trajectories,) or (seeds, trajectories), two or more"
        )
    if not np.isfinite(values).all():
        raise ValueError("values are not all finite; expected numbers")
    return values if values.ndim == 1 else values.mean(axis=0)


def _interval(mean: float, resampled: np.ndarray) -> Interval:
    tail = 50.0 * (1.0 - _CONFIDENCE)
    low, high = np.percentile(resampled, [tail, 100.0 - tail]).tolist()
    return Interval(mean, low, high)


def _resampled_means(values: np.ndarray) -> np.ndarray:
    """Means ``(RESAMPLES,)`` of as many trajectories, drawn anew with repetition; paired values share the draws."""
    return _shares(len(values)) @ values


@lru_cache(maxsize=8)
def _shares(count: int) -> np.ndarray:
    """How large a share each of ``count`` trajectories has of each resample ``(RESAMPLES, count)``."""
    draws = np.random.default_rng(_SEED).multinomial(count, np.full(count, 1.0 / count), size=RESAMPLES)
    return draws / count
