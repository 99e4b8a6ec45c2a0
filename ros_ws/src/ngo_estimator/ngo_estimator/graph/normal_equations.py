"""Sparse normal equations of one pose graph; the optimizer solves these when nobody needs a gradient.

The factors of some hundred poses fill a few per cent of the matrix.
"""

from collections.abc import Sequence

import numpy as np
from numba import njit

from ngo_estimator.data.state_arrays import Arrays, require, taken
from ngo_estimator.graph.block_cholesky import Array, BlockCholesky, BlockStructure, placed
from ngo_estimator.graph.rounding import RELATIVE_JITTER


class GraphStructure:
    """The pairs of poses that factors join: the same in all Gauss-Newton steps of an optimisation.

    Args:
        nodes: of all factors ``(factors, 2)``, each 0 to ``count - 1``; the pose of node 0 is known.
        chain: whether factors between neighbours come before these.
    """

    def __init__(self, nodes: Array, count: int, chain: bool = False) -> None:
        self.count = count
        rows, pairs = _joined(nodes, count if chain else 1)
        self.blocks = BlockStructure(pairs, count - 1)
        """Those of the information matrix, whose row ``k`` is node ``k + 1``."""
        self.ranks, self.place = placed(rows, self.blocks.rank, self.blocks.starts, self.blocks.rows)
        """Places of the factors' nodes in the order of elimination ``(factors, 2)``; -1 for node 0. Index of the block
        that joins a factor's nodes ``(factors,)``; -1 where one of them is node 0."""

    def empty(self) -> tuple[Array, Array, Array]:
        """Zeros for the blocks of a matrix, on the diagonal and below, and for a right hand side ``(nodes, 3, 1)``."""
        unknown = self.count - 1
        return np.zeros((unknown, 3, 3)), np.zeros((self.blocks.blocks, 3, 3)), np.zeros((unknown, 3, 1))


class FactorisedInformation:
    """The factorised information matrix of the poses of one graph, node 0 excepted, which is known.

    Args:
        structure: of the matrix.
        diagonal, lower: its blocks, as ``BlockCholesky`` takes them; they stay as they are.

    Raises:
        ArithmeticError: the matrix is not positive definite, as where a pose has no factor at all.
    """

    def __init__(self, structure: BlockStructure, diagonal: Array, lower: Array) -> None:
        self._structure, self._diagonal, self._lower = structure, diagonal, lower
        diagonal = diagonal.copy()
        np.einsum("kii->ki", diagonal)[:] *= 1.0 + RELATIVE_JITTER
        self._factor = BlockCholesky(structure, diagonal, lower.copy())

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
        diagonal, lower = self._factor.selected_inverse()
        rows = np.asarray(pairs) - 1
        joint = np.zeros((len(rows), 2, 3, 2, 3))
        for side in (0, 1):
            known = rows[:, side] >= 0
            joint[known, side, :, side] = diagonal[self._structure.rank[rows[known, side]]]
        both = (rows >= 0).all(1)
        place, first_below = self._structure.places(rows[both])
        block = lower[place]
        block[~first_below] = block[~first_below].mT
        joint[both, 0, :, 1], joint[both, 1, :, 0] = block, block.mT
        return joint.reshape(-1, 6, 6)

    def state(self) -> Arrays:
        """The matrix, for ``from_state``."""
        pairs = np.unique(np.sort(self._structure.pairs, axis=1), axis=0)
        return {"pairs": pairs, "diagonal": self._diagonal, "lower": self._lower}

    @classmethod
    def from_state(cls, arrays: Arrays) -> "FactorisedInformation":
        """The same again, to the last bit; raises ``StateError``."""
        pairs, diagonal = taken(arrays, "pairs", np.int64, -1, 2), taken(arrays, "diagonal", np.float64, -1, 3, 3)
        require(bool(((pairs >= 0) & (pairs < len(diagonal))).all()), "blocks are named that are not there")
        once = np.array_equal(pairs, np.unique(np.sort(pairs, axis=1), axis=0))
        require(once, "blocks are named twice, or in another order")
        structure = BlockStructure(pairs, len(diagonal))
        return FactorisedInformation(structure, diagonal, taken(arrays, "lower", np.float64, structure.blocks, 3, 3))


class NormalEquations(FactorisedInformation):
    """The factorised normal equations of one graph, at the poses where its factors were linearised.

    Args:
        hessian, gradient: the part of each factor in them, a matrix ``(factors, 6, 6)`` and a right hand side
            ``(factors, 6)`` of its two nodes.
        structure: of these factors.

    Raises:
        ArithmeticError: a pose has no factor at all.
    """

    def __init__(self, hessian: Array, gradient: Array, structure: GraphStructure) -> None:
        diagonal, lower, self._right = structure.empty()
        _add_all(structure.ranks, structure.place, hessian, gradient, diagonal, lower, self._right)
        super().__init__(structure.blocks, diagonal, lower)

    def solution(self) -> Array:
        """Changes ``(count, 3)`` of all poses; node 0 stays where it is."""
        return self.step(self._right.copy())


@njit(cache=True)
def _joined(nodes: Array, chain: int) -> tuple[Array, Array]:
    """Rows of the nodes ``(n, 2)`` of all factors, -1 for node 0, and those of two rows.

    Factors between the first ``chain`` nodes, neighbour to neighbour, come before the others.
    """
    rows = np.empty((chain - 1 + len(nodes), 2), np.int64)
    for k in range(chain - 1):
        rows[k] = k - 1, k
    for k in range(len(nodes)):
        rows[chain - 1 + k] = nodes[k, 0] - 1, nodes[k, 1] - 1
    pairs, count = np.empty_like(rows), 0
    for k in range(len(rows)):
        if rows[k, 0] >= 0 and rows[k, 1] >= 0:
            pairs[count] = rows[k]
            count += 1
    return rows, pairs[:count]


@njit(cache=True)
def _add_factor(
    hessian: Array, gradient: Array, ranks: Array, place: int, diagonal: Array, lower: Array, right: Array
) -> None:
    """Add a factor to the blocks of ``GraphStructure.empty``.

    Args:
        hessian: ``(6, 6)``; gradient: ``(6,)``.
        ranks: ``(2,)``, and ``place``: of this factor, as in the structure.
    """
    a, b = ranks
    for which in range(2):
        at, first = (b, 3) if which else (a, 0)
        if at >= 0:
            for r in range(3):
                right[at, r, 0] += gradient[first + r]
                for c in range(3):
                    diagonal[at, r, c] += hessian[first + r, first + c]
    if place >= 0:
        row, column = (0, 3) if a > b else (3, 0)
        for r in range(3):
            for c in range(3):
                lower[place, r, c] += hessian[row + r, column + c]


@njit(cache=True)
def _add_all(
    ranks: Array, place: Array, hessian: Array, gradient: Array, diagonal: Array, lower: Array, right: Array
) -> None:
    for k in range(len(ranks)):
        _add_factor(hessian[k], gradient[k], ranks[k], place[k], diagonal, lower, right)
