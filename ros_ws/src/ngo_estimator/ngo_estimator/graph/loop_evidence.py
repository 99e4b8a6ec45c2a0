"""What speaks for each loop and against it before a graph is solved, and whether covariances are as stated.

A right loop's residual is Gaussian, with a covariance that the graph gives; a wrong one's is anything on the map.
"""

import math

import numpy as np
from scipy.spatial import KDTree

from ngo_estimator.graph.corrector import GraphProblem
from ngo_estimator.graph.cycle_agreement import ChainUncertainty
from ngo_estimator.graph.loop_errors import squared_and_log
from ngo_estimator.graph.normal_equations import NormalEquations
from ngo_estimator.graph.place_agreement import place_ratio
from ngo_estimator.graph.relative_poses import RelativePoses

_PARTNERS = 16
"""Loops that each is compared with: those whose ends are nearest to its own, along the chain."""

_MOST_SUPPORT = 7.0
"""What agreeing partners can say for a loop, log odds: in a group that is wrong together all agree."""

_APART = 60
"""Nodes: loops as near as this at both ends may be wrong together, as between two stretches that look alike."""

_ASKED = 64
"""Nearest loops among which those farther apart than that are looked for."""

_AGREE = 0.2
"""Share of the partners of a right loop that are right, where a solution refuses them."""

_MOST_SAID = 5.0
"""Log odds of one of these partners: some agree by chance."""

_SCALES = np.exp(np.linspace(math.log(1e-3), math.log(1e3), 61))
_SMALL, _OFTEN = 0.115, 0.05
"""One right loop in a hundred is off by less than the first (squared, in variances of three degrees of freedom). Where
so large a share of all is, variances are no larger than stated: these may be loops that repeat the odometry."""

_ROUNDS = 12  # of expectation and maximisation, for the inlier ratio
_INFORMATIVE = 0.1  # log odds that a chain's prediction has at least where it comes true
_FEW = 30  # loops from which on a scale and an inlier ratio are estimated
_LARGEST = 50.0  # log odds of one cycle, either way


def map_area(poses: np.ndarray) -> float:
    """Area (m^2) where the end of a wrong loop may lie: the square around all poses."""
    return float(max(np.ptp(poses[:, :2], axis=0).max(), 1.0) ** 2)


def likelihood_ratio(
    squared: np.ndarray, log_determinant: np.ndarray, degrees: np.ndarray, area: float, scale: float = 1.0
) -> np.ndarray:
    """Log of how much likelier residuals ``(n,)`` are for right loops than for wrong ones.

    Args:
        squared, log_determinant: squared length of the residuals in deviations, and of their covariances.
        degrees: directions that each knows: x and y, or the yaw, too.
        area: see ``map_area``; scale: factor of the covariances.
    """
    wrong = math.log(area) + np.where(degrees > 2, math.log(2.0 * math.pi), 0.0)
    ratio: np.ndarray = wrong - 0.5 * (squared / scale + log_determinant + degrees * math.log(2.0 * math.pi * scale))
    return ratio


def scale_and_inlier_ratio(chain: ChainUncertainty, loops: RelativePoses, area: float) -> tuple[float, float]:
    """How many times as large as stated variances are, and the inlier ratio of loops, by cycles with the chain."""
    squared, logs = chain.off_chain(loops)
    # A chain that says no more than "on the map", as behind a step that nobody measured, measures no scale.
    informative = likelihood_ratio(np.zeros(len(loops)), logs, loops.degrees, area) > _INFORMATIVE
    return likeliest_mixture(squared[informative], logs[informative], loops.degrees[informative], area)


def likeliest_mixture(squared: np.ndarray, logs: np.ndarray, degrees: np.ndarray, area: float) -> tuple[float, float]:
    """The scale of the variances and the inlier ratio of right and wrong loops; arguments as of ``likelihood_ratio``.

    They are 1 and a half where there are few loops.
    """
    if len(squared) < _FEW:
        return 1.0, 0.5
    best = (-math.inf, 1.0, 0.5)
    # Wrong loops near each other along the chain look like right ones whose variances are large.
    largest = max(float(np.quantile(squared, _OFTEN)) / _SMALL, 1.0)
    for scale in _SCALES[largest >= _SCALES].tolist():
        ratio = np.clip(likelihood_ratio(squared, logs, degrees, area, scale), -_LARGEST, _LARGEST)
        inlier_ratio = 0.5
        for _ in range(_ROUNDS):
            inlier_ratio = float(
                np.clip((1.0 / (1.0 + np.exp(-ratio) * (1.0 - inlier_ratio) / inlier_ratio)).mean(), 0.05, 0.95)
            )
        best = max(best, (float(np.log(inlier_ratio * np.exp(ratio) + 1.0 - inlier_ratio).sum()), scale, inlier_ratio))
    return best[1], best[2]


def cycle_odds(
    chain: ChainUncertainty, loops: RelativePoses, area: float, inlier_ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """Log odds ``(n,)`` of loops by their cycles with the chain and with each other, from their inlier ratio on.

    The second ones are those where a chain that says no more than "on the map", as behind a step that nobody measured,
    speaks against no whole relative pose.
    """
    squared, logs = chain.off_chain(loops)
    whole = loops.degrees == 3
    odds = likelihood_ratio(squared, logs, loops.degrees, area)
    odds += math.log(inlier_ratio / (1.0 - inlier_ratio))
    for rows in (np.flatnonzero(whole), np.flatnonzero(~whole)):
        if len(rows) > 1:
            pairs = _nearest(loops.nodes[rows], _PARTNERS + 1)
            pairs = pairs[pairs[:, 0] != pairs[:, 1]]
            odds[rows] += np.minimum(_support(chain, loops[rows], pairs, area, inlier_ratio), _MOST_SUPPORT)
    least = likelihood_ratio(np.zeros(len(loops)), logs, loops.degrees, area)
    return odds, odds - np.where(whole, np.minimum(least, 0.0), 0.0)


def agreement(chain: ChainUncertainty, loops: RelativePoses, area: float) -> np.ndarray:
    """What loops ``(n,)`` that know their whole relative pose say of each other, log odds, but for those near each."""
    pairs = _nearest(loops.nodes, _ASKED)
    pairs = pairs[(np.abs(loops.nodes[pairs[:, 0]] - loops.nodes[pairs[:, 1]]) > _APART).any(1)]
    return _support(chain, loops, pairs, area, _AGREE, _MOST_SAID)


def _nearest(nodes: np.ndarray, count: int) -> np.ndarray:
    """Pairs ``(n, 2)`` of each loop and the nearest ones by their ends ``(loops, 2)``, itself among them."""
    ends, count = nodes.astype(np.float64), min(count, len(nodes))
    partner = KDTree(ends).query(ends, k=count, p=1)[1]
    return np.stack((np.repeat(np.arange(len(nodes)), count), partner.ravel()), axis=1)


def _support(
    chain: ChainUncertainty,
    loops: RelativePoses,
    pairs: np.ndarray,
    area: float,
    inlier_ratio: float,
    most: float = _LARGEST,
) -> np.ndarray:
    """What their partners say of loops ``(n,)``, log odds: each of these is right as often as the inlier ratio says.

    All loops know the heading, or none of them is asked for it; ``pairs`` ``(k, 2)`` are a loop and its partner, which
    says at most so much.
    """
    if (loops.degrees == 3).all():
        ratio = likelihood_ratio(*chain.off_pairs(loops, pairs), np.full(len(pairs), 3), area)
    else:
        ratio = place_ratio(chain, loops, pairs)
    each = np.log(inlier_ratio * np.exp(np.minimum(ratio, most)) + 1.0 - inlier_ratio)
    return np.bincount(pairs[:, 0], each, len(loops))


def predicted_odds(
    problem: GraphProblem, poses: np.ndarray, equations: NormalEquations, area: float
) -> tuple[np.ndarray, np.ndarray]:
    """Log likelihood ratios ``(loops,)`` of loops that a graph does not believe yet, and their squared residuals.

    ``equations`` are the graph's at ``poses``; all loops must be in its structure. The squared residuals ``(loops,)``
    are whitened by the covariance of the graph and of the loop together.
    """
    loops = problem.loops
    predicted = loops.predicted_covariances(poses, equations.pair_covariances(loops.nodes))
    squared, logs = squared_and_log(loops.residuals(poses), predicted)
    known = np.einsum("kii->ki", loops.root)
    logs = logs - 2.0 * np.log(np.where(known != 0.0, np.abs(known), 1.0)).sum(1)
    return likelihood_ratio(squared, logs, loops.degrees, area), squared
