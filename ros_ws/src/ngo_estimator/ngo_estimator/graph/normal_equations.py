"""Sparse normal equations of one pose graph, of images or of scans: the solver where nobody needs a gradient.

The factors of some hundred poses fill a few per cent of the matrix.
"""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from ngo_estimator.geometry.planar_motion import wrap
from ngo_estimator.graph.block_cholesky import Array, BlockCholesky, BlockStructure, placed
from ngo_estimator.graph.rounding import RELATIVE_JITTER


class GraphStructure:
    """The pairs of poses that factors join: the same in all Gauss-Newton steps of an optimisation.

    Args:
        nodes: of all factors ``(factors, 2)``, each 0 to ``count - 1``; the pose of node 0 is known.
        most_work: see ``BlockStructure``.
    """

    def __init__(self, nodes: Array, count: int, most_work: float = math.inf) -> None:
        self.nodes, self.count = nodes, count
        rows, pairs = _joined(nodes)
        self.blocks = BlockStructure(pairs, count - 1, most_work)
        """Those of the information matrix, whose row ``k`` is node ``k + 1``."""
        if not self.blocks.complete:
            return
        self.ranks, self.place = placed(rows, self.blocks.rank, self.blocks.starts, self.blocks.rows)
        """Places of the factors' nodes in the order of elimination ``(factors, 2)``; -1 for node 0. Index of the block
        that joins a factor's nodes ``(factors,)``; -1 where one of them is node 0."""

    def empty(self) -> tuple[Array, Array, Array]:
        """Zeros for the blocks of a matrix, on the diagonal and below, and for a right hand side ``(nodes, 3, 1)``."""
        unknown = self.count - 1
        return np.zeros((unknown, 3, 3)), np.zeros((self.blocks.blocks, 3, 3)), np.zeros((unknown, 3, 1))


class NormalEquations:
    """The factorised normal equations of measured relative poses, linearised at the poses of all nodes.

    Node 0 is known.

    Args:
        structure: of the factors.
        poses: where they are linearised ``(count, 3)``.
        relative: measured pose of each factor's second node, seen from its first ``(factors, 3)``.
        information: inverse covariance of these ``(factors, 3, 3)``, along the axes of the first node.

    Raises:
        ArithmeticError: the matrix is not positive definite, as where a pose has no factor at all.
    """

    def __init__(self, structure: GraphStructure, poses: Array, relative: Array, information: Array) -> None:
        self._structure = structure.blocks
        diagonal, lower, self._right = structure.empty()
        _linearise(
            poses, structure.nodes, relative, information, structure.ranks, structure.place, diagonal, lower,
            self._right,
        )  # fmt: skip
        np.einsum("kii->ki", diagonal)[:] *= 1.0 + RELATIVE_JITTER
        self._factor = BlockCholesky(self._structure, diagonal, lower)

    def solution(self) -> Array:
        """Changes ``(count, 3)`` of all poses; node 0 stays where it is."""
        return self.step(self._right.copy())

    def step(self, right: Array) -> Array:
        """Changes ``(nodes + 1, 3)`` of all poses, node 0 staying where it is.

        Args:
            right: right hand side ``(nodes, 3, 1)`` in the order of elimination; it is used up.
        """
        self._factor.solve_ordered(right)
        step = np.zeros((len(right) + 1, 3))
        step[1:] = right[self._structure.rank, :, 0]
        return step

    def covariance(self, nodes: Sequence[int] | Array) -> Array:
        """Joint covariance ``(3 n, 3 n)`` of the poses of ``n`` different nodes, node 0 excepted, in the map."""
        rows = np.asarray(nodes) - 1
        size = 3 * len(rows)
        right = np.zeros((self._structure.count, 3, size))
        right[rows] = np.eye(size).reshape(len(rows), 3, size)
        covariance: Array = self._factor.solve(right)[rows].reshape(size, size)
        return 0.5 * (covariance + covariance.T)

    def pair_covariances(self, pairs: Array) -> Array:
        """Joint covariances ``(n, 6, 6)`` of the poses of pairs ``(n, 2)`` of nodes, zero for node 0.

        Raises:
            ValueError: no factor joins a pair.
        """
        blocks, rows = self._structure, np.ascontiguousarray(pairs, np.int64) - 1
        ranks, place = placed(rows, blocks.rank, blocks.starts, blocks.rows)
        if ((place < 0) & (rows >= 0).all(1)).any():
            raise ValueError("a pair has no factor; expected pairs that a factor joins")
        return _joint(ranks, place, *self._factor.selected_inverse())


def diagonal_information(values: Array) -> Array:
    """Information matrices ``(n, 3, 3)`` of measurements with independent components of this information ``(n, 3)``."""
    information = np.zeros((*values.shape, 3))
    np.einsum("kii->ki", information)[:] = values
    return information


@njit(cache=True)
def _joint(ranks: Array, place: Array, diagonal: Array, lower: Array) -> Array:
    """Joint covariances ``(n, 6, 6)`` of pairs of rows, from the blocks of an inverse matrix; see ``placed``."""
    joint = np.zeros((len(ranks), 6, 6))
    for k in range(len(ranks)):
        for side in range(2):
            if ranks[k, side] >= 0:
                joint[k, 3 * side : 3 * side + 3, 3 * side : 3 * side + 3] = diagonal[ranks[k, side]]
        if place[k] >= 0:
            block = lower[place[k]] if ranks[k, 0] > ranks[k, 1] else lower[place[k]].T
            joint[k, :3, 3:] = block
            joint[k, 3:, :3] = block.T
    return joint


@njit(cache=True)
def _joined(nodes: Array) -> tuple[Array, Array]:
    """Rows of the nodes ``(n, 2)`` of all factors, -1 for node 0, and those of two rows."""
    rows, pairs, count = nodes - 1, np.empty_like(nodes), 0
    for k in range(len(rows)):
        if rows[k, 0] >= 0 and rows[k, 1] >= 0:
            pairs[count] = rows[k]
            count += 1
    return rows, pairs[:count]


@njit(cache=True, error_model="numpy")
def _linearise(
    poses: Array,
    nodes: Array,
    relative: Array,
    information: Array,
    ranks: Array,
    place: Array,
    diagonal: Array,
    lower: Array,
    right: Array,
) -> None:
    """Add all factors to the blocks of ``GraphStructure.empty``.

    Along the axes of the map, with the information W and the residual r, a factor's Jacobian is the identity for its
    second node and -L for its first one: L is the identity, but for what its heading does with the offset between both.
    """
    weight, lever, pull = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(len(nodes)):
        a, b = nodes[k, 0], nodes[k, 1]
        cos, sin = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        x, y = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        own = (
            relative[k, 0] - cos * x - sin * y,
            relative[k, 1] + sin * x - cos * y,
            wrap(relative[k, 2] - poses[b, 2] + poses[a, 2]),
        )
        for r in range(3):
            first, second, third = information[k, r, 0], information[k, r, 1], information[k, r, 2]
            pull[r] = first * own[0] + second * own[1] + third * own[2]
            weight[r, 0], weight[r, 1], weight[r, 2] = cos * first - sin * second, sin * first + cos * second, third
        pull[0], pull[1] = cos * pull[0] - sin * pull[1], sin * pull[0] + cos * pull[1]
        for c in range(3):
            first, second = weight[0, c], weight[1, c]
            weight[0, c], weight[1, c] = cos * first - sin * second, sin * first + cos * second
        for r in range(3):  # W L
            lever[r, 0], lever[r, 1] = weight[r, 0], weight[r, 1]
            lever[r, 2] = weight[r, 2] - y * weight[r, 0] + x * weight[r, 1]
        at, to, between = ranks[k, 0], ranks[k, 1], place[k]
        if to >= 0:
            for r in range(3):
                right[to, r, 0] += pull[r]
                for c in range(3):
                    diagonal[to, r, c] += weight[r, c]
        if between >= 0:
            for r in range(3):
                for c in range(3):
                    lower[between, r, c] -= lever[c, r] if at > to else lever[r, c]
        if at >= 0:
            for c in range(3):
                lever[2, c] += x * lever[1, c] - y * lever[0, c]  # now it is L.T W L
            pull[2] += x * pull[1] - y * pull[0]
            for r in range(3):
                right[at, r, 0] -= pull[r]
                for c in range(3):
                    diagonal[at, r, c] += lever[r, c]
