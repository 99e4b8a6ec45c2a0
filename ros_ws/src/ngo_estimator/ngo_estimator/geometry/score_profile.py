"""What a score tells along the direction that lines leave open: ends of walls, recesses, and what rays passed.

A corridor's walls say nothing of the way along it, and few of its points are on anything else. A score field knows of
all: how it falls to both sides is a likelihood, which a Gaussian prior and a Gaussian result approximate.
"""

import math
from dataclasses import replace

import numpy as np

from ngo_estimator.geometry.planar_motion import Array, wrap
from ngo_estimator.geometry.scan_matching import Registration
from ngo_estimator.geometry.score_field import ScoreField

_OPEN_M = 0.1
"""Deviation of a position below which lines and prior tell enough."""

_OFFSETS = np.linspace(-2.5, 2.5, 41)
"""Where the score is asked, in deviations of the position, or in metres where that is over 1 m."""

_ROUNDING = (_OFFSETS[1] - _OFFSETS[0]) ** 2 / 12.0
"""Variance of a place that is known to the nearest offset, in the same."""


def held_along(
    found: Registration, field: ScoreField, points: Array, unknown: float, noise: float, weight: float
) -> Registration:
    """A registration, with what the score tells of the position where lines and prior leave it over 0.1 m.

    Args:
        found: by lines and a prior.
        field: of the same map.
        points: at least one of the scan's, ``(n, 2)``.
        unknown: score of what was never seen: as much as points usually have, so that it tells nothing.
        noise: log likelihood by which the best score may be better by chance.
        weight: of a log likelihood against a mean score.
    """
    covariance = found.covariance
    variances, directions = np.linalg.eigh(covariance[:2, :2])
    variance, direction = variances[1], directions[:, 1]
    if variance < _OPEN_M**2:
        return found
    moves = covariance[:, :2] @ direction / variance  # of the pose, for each metre along the direction
    unit = min(math.sqrt(variance), 1.0)
    offsets = _OFFSETS * unit
    scores = field.scores(points, found.pose + offsets[:, None] * moves, unknown)
    prior = -0.5 * offsets**2 / variance
    before, after = np.exp(prior), np.exp(np.minimum((scores - scores.max()) / weight + noise, 0.0) + prior)
    before, after = before / before.sum(), after / after.sum()
    offset = float(after @ offsets)
    rounding = _ROUNDING * unit**2
    left = float(after @ (offsets - offset) ** 2) + rounding
    gain = max(1.0 / left - 1.0 / (float(before @ offsets**2) + rounding), 0.0)
    pose, along = found.pose + offset * moves, np.append(direction, 0.0)
    pose[2] = wrap(pose[2])
    shrunk = gain * variance**2 / (1.0 + gain * variance)
    return replace(
        found,
        pose=pose,
        covariance=covariance - shrunk * np.outer(moves, moves),
        information=found.information + gain * np.outer(along, along),
    )
