"""Sparse normal equations of one pose graph; the optimizer solves these when nobody needs a gradient.

The factors of some hundred poses fill a few per cent of the matrix. SuperLU, with an ordering of minimum degree,
factorises it several times faster than a dense Cholesky factorisation.
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu
from torch import Tensor

from ngo_estimator.data.state_arrays import Arrays, require, taken
from ngo_estimator.optimizer.gauss_newton import RELATIVE_JITTER, Factors, normal_blocks

# Pivots stay on the diagonal. No relaxed supernodes: they fill columns that have little in common, and are many times
# slower in graphs of thousands of poses.
_SYMMETRIC = {"diag_pivot_thresh": 0.0, "relax": 1, "options": {"SymmetricMode": True}}

_LEAST_REUSED = 400_000
"""Numbers in a factor from which on its use for another matrix is faster than to factorise that."""

_MOST_REFINEMENTS = 30
"""So many steps of conjugate gradients take about as long as to factorise."""

_TOLERANCE = 1e-6
"""Of a solution by another matrix's factor: its residual against the right hand side."""


class GraphStructure:
    """The pairs of poses that factors join: the same in all Gauss-Newton steps of an optimisation.

    Args:
        nodes: of all factors ``(factors, 2)``, each 0 to ``count - 1``; the pose of node 0 is known.
    """

    def __init__(self, nodes: np.ndarray, count: int) -> None:
        self.count = count
        unknown = count - 1
        pairs = nodes - 1
        self.rank = _order_of_elimination(pairs[(pairs >= 0).all(1)], unknown)
        """Place of each node but node 0 in the order of elimination ``(count - 1,)``."""
        ranks = self.rank[pairs]
        row, column = ranks[:, [0, 0, 1, 1]].ravel(), ranks[:, [0, 1, 0, 1]].ravel()
        known = (pairs[:, [0, 0, 1, 1]] < 0).ravel() | (pairs[:, [0, 1, 0, 1]] < 0).ravel()
        diagonal = np.arange(unknown)
        keys = np.concatenate((column * unknown + row, diagonal * unknown + diagonal))
        blocks, block = np.unique(keys[np.append(~known, np.ones(unknown, bool))], return_inverse=True)
        # Node 0 is known: its blocks are summed behind all others, and not used.
        self._block = torch.full((len(row),), len(blocks))
        self._block[torch.from_numpy(~known)] = torch.from_numpy(block[: len(block) - unknown])
        block_column, block_row = blocks // unknown, blocks % unknown
        height = np.bincount(block_column, minlength=unknown)
        first = np.concatenate(([0], np.cumsum(height)))
        rank = np.arange(len(blocks)) - first[block_column]
        # A column of blocks is three columns of the matrix, each with three rows of every block.
        i, k = np.arange(3)[:, None], np.arange(3)[None, :]
        inside = 3 * rank[:, None, None] + i + 3 * height[block_column][:, None, None] * k
        self._place = 9 * first[block_column][:, None, None] + inside
        self._indices = np.empty(9 * len(blocks), np.int32)
        self._indices[self._place] = np.broadcast_to(3 * block_row[:, None, None] + i, self._place.shape)
        starts = 9 * first[:-1, None] + 3 * height[:, None] * np.arange(3)
        self._indptr = np.append(starts.ravel(), 9 * len(blocks)).astype(np.int32)
        self._is_diagonal = block_column == block_row

    def matrix(self, hessian: Tensor) -> csc_matrix:
        """The factors' ``(factors, 6, 6)`` summed, without node 0, in an order that leaves few entries to eliminate."""
        parts = hessian.unflatten(-1, (2, 3)).unflatten(-3, (2, 3)).transpose(2, 3).reshape(-1, 9)
        summed = torch.zeros(len(self._is_diagonal) + 1, 9, dtype=torch.float64).index_add_(0, self._block, parts)
        blocks = summed[:-1].numpy()
        blocks[self._is_diagonal, ::4] *= 1.0 + RELATIVE_JITTER
        data = np.empty(9 * len(blocks))
        data[self._place] = blocks.reshape(-1, 3, 3)
        size = 3 * (self.count - 1)
        return csc_matrix((data, self._indices, self._indptr), shape=(size, size))


def _order_of_elimination(pairs: np.ndarray, count: int) -> np.ndarray:
    """Place of each node ``(count,)`` in an ordering of minimum degree, found on single numbers instead of blocks."""
    degree = np.bincount(pairs.ravel(), minlength=count) + 1.0
    values = np.concatenate((np.full(2 * len(pairs), -1.0), degree))
    diagonal = np.arange(count)
    rows, columns = (np.concatenate((pairs[:, k], pairs[:, 1 - k], diagonal)) for k in (0, 1))
    matrix = csc_matrix((values, (rows, columns)), shape=(count, count))
    order: np.ndarray = splu(matrix, permc_spec="MMD_AT_PLUS_A", **_SYMMETRIC).perm_c
    return order.astype(np.int64)


def _factorised(matrix: csc_matrix) -> SuperLU:
    return splu(matrix, permc_spec="NATURAL", **_SYMMETRIC)


class FactorisedInformation:
    """The factorised information matrix of the poses of one graph, node 0 excepted, which is known.

    Args:
        rank: place of each pose in the order of elimination ``(poses,)``.
        matrix: ``(3 poses, 3 poses)``, in this order.
        near: the same poses in the same order, with a matrix that differs little. Where factors are large, its factor
            serves: conjugate gradients solve what the difference leaves.
    """

    def __init__(self, rank: np.ndarray, matrix: csc_matrix, near: "FactorisedInformation | None" = None) -> None:
        self._rank, self._matrix = rank, matrix
        large = near is not None and near._factor.nnz >= _LEAST_REUSED
        self._exact = not large
        self._factor: SuperLU = near._factor if near is not None and large else _factorised(matrix)

    def _solved(self, right: np.ndarray) -> np.ndarray:
        """Solution ``(rows,)`` of the equations with the right hand side ``(rows,)``."""
        solution: np.ndarray
        if not self._exact:
            known = LinearOperator(self._matrix.shape, self._factor.solve, dtype=np.float64)
            solution, failed = cg(self._matrix, right, rtol=_TOLERANCE, maxiter=_MOST_REFINEMENTS, M=known)
            if not failed:
                return solution
            self._factor, self._exact = _factorised(self._matrix), True
        solution = self._factor.solve(right)
        return solution

    def rows(self, nodes: np.ndarray) -> np.ndarray:
        """Rows of the matrix ``(n, 3)`` that belong to nodes ``(n,)``, none of them node 0."""
        rows: np.ndarray = 3 * self._rank[nodes - 1][:, None] + np.arange(3)
        return rows

    def covariance(self, nodes: Sequence[int]) -> np.ndarray:
        """Joint covariance ``(3 n, 3 n)`` of the poses of ``n`` different nodes, node 0 excepted, in the map."""
        wanted = self.rows(np.asarray(nodes)).ravel()
        right = np.zeros((self._matrix.shape[0], len(wanted)))
        right[wanted, np.arange(len(wanted))] = 1.0
        if not self._exact:
            self._factor, self._exact = _factorised(self._matrix), True
        covariance: np.ndarray = self._factor.solve(right)[wanted]
        return 0.5 * (covariance + covariance.T)

    def state(self) -> Arrays:
        """The matrix, for ``from_state``."""
        matrix = self._matrix
        return {"rank": self._rank, "data": matrix.data, "indices": matrix.indices, "indptr": matrix.indptr}

    @classmethod
    def from_state(cls, arrays: Arrays) -> "FactorisedInformation":
        """The same again, to the last bit; raises ``StateError``."""
        rank, data = taken(arrays, "rank", np.int64, -1), taken(arrays, "data", np.float64, -1)
        size = 3 * len(rank)
        indices, indptr = taken(arrays, "indices", np.int32, len(data)), taken(arrays, "indptr", np.int32, size + 1)
        require(np.array_equal(np.sort(rank), np.arange(len(rank))), "the order of elimination is no permutation")
        matrix = csc_matrix((data, indices, indptr), shape=(size, size))
        matrix.check_format()
        return FactorisedInformation(rank, matrix)


class NormalEquations(FactorisedInformation):
    """The factorised normal equations of one graph, at the poses where its factors were linearised."""

    def __init__(
        self, factors: Sequence[Factors], structure: GraphStructure, near: FactorisedInformation | None = None
    ) -> None:
        """Sum the factors of a batch of one; raises ``RuntimeError`` where a pose has no factor at all."""
        nodes, hessian, gradient = (blocks[0] for blocks in normal_blocks(factors))
        self._right = torch.zeros(structure.count, 3, dtype=torch.float64)
        self._right.index_add_(0, nodes.flatten(), gradient.reshape(-1, 3))
        super().__init__(structure.rank, structure.matrix(hessian), near)

    def step(self) -> Tensor:
        """Changes ``(1, count, 3)`` of all poses, float64; node 0 stays where it is."""
        count = len(self._right)
        rows = self.rows(np.arange(1, count))
        right = np.empty(rows.size)
        right[rows] = self._right[1:].numpy()
        step = np.zeros((count, 3))
        step[1:] = self._solved(right)[rows]
        return torch.from_numpy(step).unsqueeze(0)
