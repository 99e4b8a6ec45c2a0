"""What the cycles of a pose graph say before anything is solved: a loop against its chain, and two loops in one cycle.

A cycle's residual is compared with the covariance of all that is in it. Two right loops agree; a wrong one agrees with
another by chance only where the stretches of chain between them are long (pairwise consistency, Mangelson et al. 2018).
"""

import math
from copy import copy

import numpy as np
from numba import njit

from ngo_estimator.geometry.se2 import compose, r2g
from ngo_estimator.graph.relative_poses import RelativePoses

_NOTHING_KNOWN = 1e12
"""Variance of a direction of which a loop says nothing."""

_HELD = 0.1
"""Variances of a chain that loops hold, as a share of those without them."""


class ChainUncertainty:
    """How far the chain of steps lets any node lie from any other, by sums over the steps up to each node.

    Args:
        steps: from each node to the next, whose composition gives the nodes' poses.
    """

    def __init__(self, steps: RelativePoses) -> None:
        self.poses = chain_poses(steps.relative)
        """Where the steps alone put the nodes ``(nodes, 3)``."""
        start, end = self.poses[:-1], self.poses[1:]
        # An error at the end of a step moves all that is behind it: it is a small motion of the map about its origin.
        moved = np.zeros((len(steps), 3, 3))
        moved[:, 0, 0] = moved[:, 1, 1] = np.cos(start[:, 2])
        moved[:, 1, 0], moved[:, 2, 2] = np.sin(start[:, 2]), 1.0
        moved[:, 0, 1] = -moved[:, 1, 0]
        moved[:, 0, 2], moved[:, 1, 2] = end[:, 1], -end[:, 0]
        sums = np.cumsum(moved @ covariances(steps) @ moved.mT, axis=0)
        self.sums = np.concatenate((np.zeros((1, 3, 3)), sums))
        """Covariances ``(nodes, 3, 3)`` of what all steps before a node move the map by, about its origin."""

    def bent(self, poses: np.ndarray) -> "ChainUncertainty":
        """The chain where a solution puts the nodes ``(nodes, 3)``: loops hold it, so that it is known better."""
        bent = copy(self)
        bent.poses, bent.sums = poses, _HELD * self.sums
        return bent

    def off_chain(self, loops: RelativePoses) -> tuple[np.ndarray, np.ndarray]:
        """Squared residual of each loop against the chain ``(n,)``, and the log of its covariance's determinant.

        Directions of which a loop knows nothing count in neither.
        """
        return _off_chain(self.poses, self.sums, loops.nodes, loops.relative, covariances(loops))

    def off_pairs(self, loops: RelativePoses, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same of cycles of two loops ``pairs`` ``(n, 2)`` and the chain between their ends.

        Raises:
            ValueError: a loop does not know its whole relative pose.
        """
        if (loops.degrees < 3).any():
            raise ValueError("a loop does not know its whole relative pose; expected loops that do")
        return _off_pairs(self.poses, self.sums, loops.nodes, loops.relative, covariances(loops), pairs)


def chain_poses(relative: np.ndarray, first: np.ndarray | None = None) -> np.ndarray:
    """Poses ``(n + 1, 3)`` of a chain of relative poses ``(n, 3)``; the first is the origin if not given."""
    poses: np.ndarray = np.concatenate((np.zeros((1, 3)), r2g(relative)))
    return poses if first is None else compose(first, poses)


def covariances(edges: RelativePoses) -> np.ndarray:
    """Covariances ``(n, 3, 3)``, with a variance beyond all others in a direction of which an edge knows nothing."""
    information = edges.root.mT @ edges.root
    unknown = np.einsum("kii->ki", information) == 0.0
    np.einsum("kii->ki", information)[unknown] = 1.0 / _NOTHING_KNOWN
    inverse: np.ndarray = np.linalg.inv(information)
    return inverse


@njit(cache=True)
def add_turned(total: np.ndarray, later: np.ndarray, earlier: np.ndarray, x: float, y: float, angle: float) -> None:
    """Add to the lower half of ``total`` the covariance of a motion about the map's origin, as seen at a point.

    The covariance is ``later`` less ``earlier``, and axes are turned. Written out: products of small matrices take ten
    times as long.
    """
    a, b, d = later[0, 0] - earlier[0, 0], later[1, 0] - earlier[1, 0], later[1, 1] - earlier[1, 1]
    e, f, g = later[2, 0] - earlier[2, 0], later[2, 1] - earlier[2, 1], later[2, 2] - earlier[2, 2]
    # Of the point (x, y): dx = tx - y t, dy = ty + x t; then turned.
    c, s = math.cos(angle), math.sin(angle)
    u, v = -c * y - s * x, c * x - s * y
    m00, m01, m02 = c * a - s * b + u * e, c * b - s * d + u * f, c * e - s * f + u * g
    m10, m11, m12 = s * a + c * b + v * e, s * b + c * d + v * f, s * e + c * f + v * g
    total[0, 0] += m00 * c - m01 * s + m02 * u
    total[1, 0] += m10 * c - m11 * s + m12 * u
    total[1, 1] += m10 * s + m11 * c + m12 * v
    total[2, 0] += e * c - f * s + g * u
    total[2, 1] += e * s + f * c + g * v
    total[2, 2] += g


@njit(cache=True)
def _squared(covariance: np.ndarray, x: float, y: float, yaw: float) -> tuple[float, float]:
    """Squared Mahalanobis length of a residual, and the log of the determinant; without what nobody knows."""
    yaw = math.atan2(math.sin(yaw), math.cos(yaw))
    a, b, c = covariance[0, 0], covariance[1, 0], covariance[1, 1]
    d, e, f = covariance[2, 0], covariance[2, 1], covariance[2, 2]
    l00 = math.sqrt(a)
    l10 = b / l00
    l11 = math.sqrt(max(c - l10 * l10, 1e-300))
    l20 = d / l00
    l21 = (e - l20 * l10) / l11
    u = x / l00
    v = (y - l10 * u) / l11
    squared, log = u * u + v * v, 2.0 * math.log(l00 * l11)
    if f < 0.5 * _NOTHING_KNOWN:
        l22 = math.sqrt(max(f - l20 * l20 - l21 * l21, 1e-300))
        w = (yaw - l20 * u - l21 * v) / l22
        squared += w * w
        log += 2.0 * math.log(l22)
    return squared, log


@njit(cache=True)
def _off_chain(
    poses: np.ndarray, sums: np.ndarray, nodes: np.ndarray, relative: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    count = len(nodes)
    squared, logs = np.empty(count), np.empty(count)
    for n in range(count):
        i, j = nodes[n]
        c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        x, y = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        total = covariance[n].copy()
        add_turned(total, sums[max(i, j)], sums[min(i, j)], poses[j, 0], poses[j, 1], -poses[i, 2])
        squared[n], logs[n] = _squared(
            total,
            c * x + s * y - relative[n, 0],
            c * y - s * x - relative[n, 1],
            poses[j, 2] - poses[i, 2] - relative[n, 2],
        )
    return squared, logs


@njit(cache=True)
def _off_pairs(
    poses: np.ndarray,
    sums: np.ndarray,
    nodes: np.ndarray,
    relative: np.ndarray,
    covariance: np.ndarray,
    pairs: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The way from i by chain to k, by the second loop to l, by chain to j, beside the first loop from i to j."""
    count, nothing = len(pairs), np.zeros((3, 3))
    squared, logs = np.empty(count), np.empty(count)
    for n in range(count):
        a, b = pairs[n]
        i, j = nodes[a]
        k, l = nodes[b]  # noqa: E741
        ci, si = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        x, y = poses[k, 0] - poses[i, 0], poses[k, 1] - poses[i, 1]
        kx, ky, kt = ci * x + si * y, ci * y - si * x, poses[k, 2] - poses[i, 2]
        ck, sk = math.cos(kt), math.sin(kt)
        lx, ly = kx + ck * relative[b, 0] - sk * relative[b, 1], ky + sk * relative[b, 0] + ck * relative[b, 1]
        lt = kt + relative[b, 2]
        turned = lt - poses[l, 2]
        ct, st = math.cos(turned), math.sin(turned)
        x, y = poses[j, 0] - poses[l, 0], poses[j, 1] - poses[l, 1]
        jx, jy, jt = lx + ct * x - st * y, ly + st * x + ct * y, poses[j, 2] + turned
        total = covariance[a].copy()
        # An error between i and k turns all that follows about the map's origin: j as this way puts it.
        mx, my = poses[i, 0] + ci * jx - si * jy, poses[i, 1] + si * jx + ci * jy
        add_turned(total, sums[max(i, k)], sums[min(i, k)], mx, my, -poses[i, 2])
        add_turned(total, sums[max(l, j)], sums[min(l, j)], poses[j, 0], poses[j, 1], turned)
        # The second loop's own error is at l, along the axes of k.
        add_turned(total, covariance[b], nothing, ck * (jx - lx) + sk * (jy - ly), ck * (jy - ly) - sk * (jx - lx), kt)
        squared[n], logs[n] = _squared(total, jx - relative[a, 0], jy - relative[a, 1], jt - relative[a, 2])
    return squared, logs
