"""What the cycle of two loops says where these know places alone: the ways between the places are equal, seen twice.

The robot went from one place to another, and at another time from the one to the other again. Where both loops are
right, both ways are equally long, and lead in one direction; neither depends on a heading that a loop would have to
know.
"""

import math

import numpy as np
from numba import njit

from ngo_estimator.graph.cycle_agreement import ChainUncertainty, add_turned, covariances
from ngo_estimator.graph.relative_poses import RelativePoses

_LEAST_WAY = 0.3
"""A direction is that of a way of so many metres at least."""

_ANY_DIRECTION = math.pi**2 / 3.0
"""Variance of a direction of which nothing is known."""


def place_ratio(chain: ChainUncertainty, loops: RelativePoses, pairs: np.ndarray) -> np.ndarray:
    """Log ``(n,)`` of how much likelier the ways between two loops ``pairs`` ``(n, 2)`` are if both are right.

    Of the loops, headings are not asked for.
    """
    covariance = covariances(loops)
    variance = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])
    travelled = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(chain.poses[:, :2], axis=0).T))))
    return _place_ratio(chain.poses, chain.sums, travelled, loops.nodes, loops.relative[:, :2], variance, pairs)


@njit(cache=True)
def _seen_at(pose: np.ndarray, position: np.ndarray) -> tuple[float, float]:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + c * position[0] - s * position[1], pose[1] + s * position[0] + c * position[1]


@njit(cache=True)
def _way(
    sums: np.ndarray, i: int, k: int, ax: float, ay: float, bx: float, by: float
) -> tuple[float, float, float, float]:
    """Length and direction of the way from a place a seen at node i to b seen at k, by the chain, and their variances.

    The second one is that across the way (m^2).
    """
    x, y = bx - ax, by - ay
    length, direction = math.hypot(x, y), math.atan2(y, x)
    total = np.zeros((3, 3))
    add_turned(total, sums[max(i, k)], sums[min(i, k)], bx, by, -direction)
    return length, direction, total[0, 0], total[1, 1]


@njit(cache=True)
def _place_ratio(
    poses: np.ndarray,
    sums: np.ndarray,
    travelled: np.ndarray,
    nodes: np.ndarray,
    position: np.ndarray,
    variance: np.ndarray,
    pairs: np.ndarray,
) -> np.ndarray:
    ratio = np.empty(len(pairs))
    for n in range(len(pairs)):
        a, b = pairs[n]
        i, j = nodes[a]
        k, l = nodes[b]  # noqa: E741
        ax, ay = _seen_at(poses[i], position[a])
        bx, by = _seen_at(poses[k], position[b])
        first, at_first, along_first, across_first = _way(sums, i, k, ax, ay, bx, by)
        second, at_second, along_second, across_second = _way(
            sums, j, l, poses[j, 0], poses[j, 1], poses[l, 0], poses[l, 1]
        )
        loop = variance[a] + variance[b]
        # Ways of loops that are wrong may differ by all that the robot went between their nodes.
        most = 0.5 * (abs(travelled[i] - travelled[k]) + abs(travelled[j] - travelled[l]))
        known = loop + along_first + along_second
        ratio[n] = _likelier(first - second, known, most * most / 3.0)
        shorter = max(min(first, second), _LEAST_WAY)
        turned = sums[max(i, j), 2, 2] - sums[min(i, j), 2, 2]
        known = turned + (loop + across_first + across_second) / (shorter * shorter)
        off = at_first - at_second
        ratio[n] += _likelier(math.atan2(math.sin(off), math.cos(off)), known, _ANY_DIRECTION)
    return ratio


@njit(cache=True)
def _likelier(off: float, known: float, more: float) -> float:
    """Log ratio of a difference under a variance and under one that is larger by ``more``."""
    return 0.5 * (math.log1p(more / known) + off * off * (1.0 / (known + more) - 1.0 / known))
