"""Cholesky factorisation of sparse symmetric matrices of 3x3 blocks: a pose graph's information matrix.

Compiled. A graph of some hundred poses takes less time here than one call of a general library, since a block needs one
index instead of nine. The order of elimination is of minimum degree, found on rows of bits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]

_ONE = np.uint64(1)
_ODD, _PAIRS = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
_NIBBLES, _BYTES = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
_S1, _S2, _S4, _S56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)


class BlockStructure:
    """The blocks below the diagonal that a matrix and its factor can fill, in the order of elimination.

    Args:
        pairs: rows that blocks beside the diagonal join ``(n, 2)``, each 0 to ``count - 1``, in any order and number.
        count: rows of blocks.
        most_work: how many blocks a factorisation may multiply. Beyond it the order of elimination is not found to its
            end, and the structure is of no use.
    """

    def __init__(self, pairs: Array, count: int, most_work: float = math.inf) -> None:
        self.pairs = np.ascontiguousarray(pairs, np.int64).reshape(-1, 2)
        if len(self.pairs) and not 0 <= self.pairs.min() <= self.pairs.max() < count:
            raise ValueError(f"pairs join rows {self.pairs.min()} to {self.pairs.max()}; expected 0 to {count - 1}")
        self.count = count
        self.rank, self.starts, self.rows = _eliminated(self.pairs, count, float(most_work))
        """Place of each row in the order ``(count,)``; where the blocks of each column begin ``(count + 1,)``; the
        places of their rows ``(blocks,)``, ascending in a column."""
        self.complete = len(self.starts) == count + 1
        """Whether the order of elimination was found to its end."""

    @property
    def blocks(self) -> int:
        """Blocks below the diagonal."""
        return len(self.rows)


class BlockCholesky:
    """A factorised matrix.

    Args:
        structure: its blocks.
        diagonal: its blocks on the diagonal, symmetric, in the order of elimination ``(count, 3, 3)``.
        lower: those below, row by column ``(blocks, 3, 3)``.

    Both arrays become the factor's.

    Raises:
        ArithmeticError: the matrix is not positive definite.
    """

    def __init__(self, structure: BlockStructure, diagonal: Array, lower: Array) -> None:
        self._structure, self._diagonal, self._lower = structure, diagonal, lower
        failed = factorise(structure.starts, structure.rows, diagonal, lower)
        if failed >= 0:
            raise ArithmeticError(f"the matrix is not positive definite in row {failed} of {structure.count}")

    def solve(self, right: Array) -> Array:
        """Solution ``(count, 3, n)`` for right hand sides of this shape, rows as the pairs count them."""
        ordered = np.empty_like(right)
        ordered[self._structure.rank] = right
        self.solve_ordered(ordered)
        solution: Array = ordered[self._structure.rank]
        return solution

    def solve_ordered(self, right: Array) -> None:
        """Solve in place for right hand sides ``(count, 3, n)`` whose rows are in the order of elimination."""
        solve(self._structure.starts, self._structure.rows, self._diagonal, self._lower, right)

    def selected_inverse(self) -> tuple[Array, Array]:
        """The inverse matrix at the structure's blocks alone: on the diagonal, and below, in the order of elimination.

        It costs about as much as the factor (Takahashi, Fagan, Chen 1973).
        """
        diagonal, lower = np.empty_like(self._diagonal), np.empty_like(self._lower)
        _selected_inverse(self._structure.starts, self._structure.rows, self._diagonal, self._lower, diagonal, lower)
        return diagonal, lower


@njit(cache=True)
def _bits(word: Any) -> Any:
    """How many bits of 64 are set."""
    word = word - ((word >> _S1) & _ODD)
    word = (word & _PAIRS) + ((word >> _S2) & _PAIRS)
    word = (word + (word >> _S4)) & _NIBBLES
    return np.int64((word * _BYTES) >> _S56)


@njit(cache=True)
def _lowest(word: Any) -> Any:
    """The lowest bit of those that are set."""
    return word & (~word + _ONE)


@njit(cache=True)
def _eliminated(pairs: Array, count: int, most_work: float) -> tuple[Array, Array, Array]:
    """Rank of each row, starts of the factor's columns, and the ranks of their rows.

    The first row of least degree is eliminated next. There are fewer starts where there is too much work.
    """
    words = (count + 63) // 64
    neighbours = np.zeros((count, words), np.uint64)
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        if a != b:
            neighbours[a, b // 64] |= _ONE << np.uint64(b % 64)
            neighbours[b, a // 64] |= _ONE << np.uint64(a % 64)
    degree, of_degree = np.zeros(count, np.int64), np.zeros((count, words), np.uint64)
    for a in range(count):
        for w in range(words):
            degree[a] += _bits(neighbours[a, w])
        of_degree[degree[a], a // 64] |= _ONE << np.uint64(a % 64)
    rank = np.empty(count, np.int64)
    starts = np.zeros(count + 1, np.int64)
    rows = np.empty(max(16, 8 * count), np.int64)
    filled = 0
    least = 0
    work = 0.0
    for step in range(count):
        pivot = -1
        while pivot < 0:
            for w in range(words):
                if of_degree[least, w] != np.uint64(0):
                    pivot = 64 * w + _bits(_lowest(of_degree[least, w]) - _ONE)
                    break
            least += 1
        # An elimination lowers the least degree by one at most.
        least = max(least - 2, 0)
        rank[pivot] = step
        own = ~(_ONE << np.uint64(pivot % 64))
        of_degree[degree[pivot], pivot // 64] &= own
        if filled + count > len(rows):
            more = np.empty(2 * len(rows) + count, np.int64)
            more[:filled] = rows[:filled]
            rows = more
        first = filled
        for w in range(words):
            word = neighbours[pivot, w]
            while word != np.uint64(0):
                lowest = _lowest(word)
                rows[filled] = 64 * w + _bits(lowest - _ONE)
                filled += 1
                word ^= lowest
        starts[step + 1] = filled
        work += float(filled - first) ** 2
        if work > most_work:
            return rank, starts[:step], rows[:0]
        for k in range(first, filled):
            a = rows[k]
            here = _ONE << np.uint64(a % 64)
            for w in range(words):
                neighbours[a, w] |= neighbours[pivot, w]
            neighbours[a, pivot // 64] &= own
            neighbours[a, a // 64] &= ~here
            total = 0
            for w in range(words):
                total += _bits(neighbours[a, w])
            if total != degree[a]:
                of_degree[degree[a], a // 64] &= ~here
                of_degree[total, a // 64] |= here
                degree[a] = total
    rows = rows[:filled].copy()
    for step in range(count):
        for k in range(starts[step], starts[step + 1]):  # a column is short: insertion sorts it fastest
            value, at = rank[rows[k]], k
            while at > starts[step] and rows[at - 1] > value:
                rows[at] = rows[at - 1]
                at -= 1
            rows[at] = value
    return rank, starts, rows


@njit(cache=True)
def placed(pairs: Array, rank: Array, starts: Array, rows: Array) -> tuple[Array, Array]:
    """Ranks ``(n, 2)`` of pairs of rows, and the index of the block of each, -1 where there is none.

    A negative row has the rank -1 and no block.
    """
    ranks, place = np.full((len(pairs), 2), -1), np.full(len(pairs), -1)
    for k in range(len(pairs)):
        for side in range(2):
            if pairs[k, side] >= 0:
                ranks[k, side] = rank[pairs[k, side]]
        column, row = min(ranks[k, 0], ranks[k, 1]), max(ranks[k, 0], ranks[k, 1])
        if column < 0:
            continue
        low, high = starts[column], starts[column + 1]
        at = low + np.searchsorted(rows[low:high], row)
        if at < high and rows[at] == row:
            place[k] = at
    return ranks, place


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def factorise(starts: Array, rows: Array, diagonal: Array, lower: Array) -> int:
    """Factorise in place, column by column; returns -1, or the row where the matrix is not positive definite.

    Each column takes from itself what the columns before it, in whose rows it is, ask for. A list for each row holds
    these: ``head`` is its first column, ``after`` the one behind a column, ``at`` the row's place in that column.
    """
    count = len(diagonal)
    where, after, at = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    head = np.full(count, -1)
    for j in range(count):
        first, last = starts[j], starts[j + 1]
        for p in range(first, last):
            where[rows[p]] = p
        d = diagonal[j]
        d00, d10, d11, d20, d21, d22 = d[0, 0], d[1, 0], d[1, 1], d[2, 0], d[2, 1], d[2, 2]
        column = head[j]
        while column >= 0:
            following, q, end = after[column], at[column], starts[column + 1]
            block = lower[q]
            q00, q01, q02 = block[0, 0], block[0, 1], block[0, 2]
            q10, q11, q12 = block[1, 0], block[1, 1], block[1, 2]
            q20, q21, q22 = block[2, 0], block[2, 1], block[2, 2]
            d00 -= q00 * q00 + q01 * q01 + q02 * q02
            d10 -= q10 * q00 + q11 * q01 + q12 * q02
            d11 -= q10 * q10 + q11 * q11 + q12 * q12
            d20 -= q20 * q00 + q21 * q01 + q22 * q02
            d21 -= q20 * q10 + q21 * q11 + q22 * q12
            d22 -= q20 * q20 + q21 * q21 + q22 * q22
            for p in range(q + 1, end):
                block, target = lower[p], lower[where[rows[p]]]
                # Written out: as a loop over three rows it takes a third longer.
                x, y, z = block[0, 0], block[0, 1], block[0, 2]
                target[0, 0] -= x * q00 + y * q01 + z * q02
                target[0, 1] -= x * q10 + y * q11 + z * q12
                target[0, 2] -= x * q20 + y * q21 + z * q22
                x, y, z = block[1, 0], block[1, 1], block[1, 2]
                target[1, 0] -= x * q00 + y * q01 + z * q02
                target[1, 1] -= x * q10 + y * q11 + z * q12
                target[1, 2] -= x * q20 + y * q21 + z * q22
                x, y, z = block[2, 0], block[2, 1], block[2, 2]
                target[2, 0] -= x * q00 + y * q01 + z * q02
                target[2, 1] -= x * q10 + y * q11 + z * q12
                target[2, 2] -= x * q20 + y * q21 + z * q22
            if q + 1 < end:
                row = rows[q + 1]
                at[column], after[column], head[row] = q + 1, head[row], column
            column = following
        if not d00 > 0.0:
            return j
        d00 = math.sqrt(d00)
        d10, d20 = d10 / d00, d20 / d00
        rest = d11 - d10 * d10
        if not rest > 0.0:
            return j
        d11 = math.sqrt(rest)
        d21 = (d21 - d20 * d10) / d11
        rest = d22 - d20 * d20 - d21 * d21
        if not rest > 0.0 or not math.isfinite(rest):
            return j
        d22 = math.sqrt(rest)
        d[0, 0], d[1, 0], d[2, 0], d[1, 1], d[2, 1], d[2, 2] = d00, d10, d20, d11, d21, d22
        d[0, 1] = d[0, 2] = d[1, 2] = 0.0
        by_0, by_1, by_2 = 1.0 / d00, 1.0 / d11, 1.0 / d22
        for p in range(first, last):
            for r in range(3):
                x = lower[p, r, 0] * by_0
                y = (lower[p, r, 1] - x * d10) * by_1
                lower[p, r, 0], lower[p, r, 1] = x, y
                lower[p, r, 2] = (lower[p, r, 2] - x * d20 - y * d21) * by_2
        if first < last:
            row = rows[first]
            at[j], after[j], head[row] = first, head[row], j
    return -1


@njit(cache=True, error_model="numpy")
def solve(starts: Array, rows: Array, diagonal: Array, lower: Array, x: Array) -> None:
    """Solve in place for right hand sides ``(count, 3, n)``, all in the order of elimination."""
    sides = x.shape[2]
    for k in range(len(diagonal)):
        d = diagonal[k]
        for s in range(sides):
            a = x[k, 0, s] / d[0, 0]
            b = (x[k, 1, s] - d[1, 0] * a) / d[1, 1]
            c = (x[k, 2, s] - d[2, 0] * a - d[2, 1] * b) / d[2, 2]
            x[k, 0, s], x[k, 1, s], x[k, 2, s] = a, b, c
            if a == 0.0 and b == 0.0 and c == 0.0:
                continue
            for p in range(starts[k], starts[k + 1]):
                row = rows[p]
                for r in range(3):
                    x[row, r, s] -= lower[p, r, 0] * a + lower[p, r, 1] * b + lower[p, r, 2] * c
    for k in range(len(diagonal) - 1, -1, -1):
        d = diagonal[k]
        for s in range(sides):
            a, b, c = x[k, 0, s], x[k, 1, s], x[k, 2, s]
            for p in range(starts[k], starts[k + 1]):
                row = rows[p]
                for r in range(3):
                    value = x[row, r, s]
                    a -= lower[p, r, 0] * value
                    b -= lower[p, r, 1] * value
                    c -= lower[p, r, 2] * value
            c = c / d[2, 2]
            b = (b - d[2, 1] * c) / d[1, 1]
            x[k, 0, s], x[k, 1, s], x[k, 2, s] = (a - d[1, 0] * b - d[2, 0] * c) / d[0, 0], b, c


@njit(cache=True, error_model="numpy")
def _selected_inverse(
    starts: Array, rows: Array, diagonal: Array, lower: Array, inverse_diagonal: Array, inverse_lower: Array
) -> None:
    """Fill the blocks of the inverse from the last column to the first, from a factor with such blocks."""
    count = len(diagonal)
    place = np.full(count, -1)
    for j in range(count - 1, -1, -1):
        first, last = starts[j], starts[j + 1]
        d = diagonal[j]
        inverse = np.zeros((3, 3))
        inverse[0, 0], inverse[1, 1], inverse[2, 2] = 1.0 / d[0, 0], 1.0 / d[1, 1], 1.0 / d[2, 2]
        inverse[1, 0] = -d[1, 0] * inverse[0, 0] * inverse[1, 1]
        inverse[2, 1] = -d[2, 1] * inverse[1, 1] * inverse[2, 2]
        inverse[2, 0] = -(d[2, 0] * inverse[0, 0] + d[2, 1] * inverse[1, 0]) * inverse[2, 2]
        sums = np.zeros((last - first, 3, 3))
        for p in range(first, last):
            place[rows[p]] = p
        for p in range(first, last):
            column = rows[p]
            # Written out, as in ``factorise``.
            block = lower[p]
            x0, x1, x2 = block[0, 0], block[1, 0], block[2, 0]
            y0, y1, y2 = block[0, 1], block[1, 1], block[2, 1]
            z0, z1, z2 = block[0, 2], block[1, 2], block[2, 2]
            mine = sums[p - first]
            for r in range(3):
                a, b, c = inverse_diagonal[column, r, 0], inverse_diagonal[column, r, 1], inverse_diagonal[column, r, 2]
                mine[r, 0] += a * x0 + b * x1 + c * x2
                mine[r, 1] += a * y0 + b * y1 + c * y2
                mine[r, 2] += a * z0 + b * z1 + c * z2
            for q in range(starts[column], starts[column + 1]):
                other = place[rows[q]]
                if other < 0:
                    continue
                theirs, below, across = sums[other - first], inverse_lower[q], lower[other]
                for r in range(3):
                    a, b, c = below[r, 0], below[r, 1], below[r, 2]
                    theirs[r, 0] += a * x0 + b * x1 + c * x2
                    theirs[r, 1] += a * y0 + b * y1 + c * y2
                    theirs[r, 2] += a * z0 + b * z1 + c * z2
                    a, b, c = below[0, r], below[1, r], below[2, r]
                    mine[r, 0] += a * across[0, 0] + b * across[1, 0] + c * across[2, 0]
                    mine[r, 1] += a * across[0, 1] + b * across[1, 1] + c * across[2, 1]
                    mine[r, 2] += a * across[0, 2] + b * across[1, 2] + c * across[2, 2]
        own = inverse.copy().T
        for p in range(first, last):
            place[rows[p]] = -1
            for r in range(3):
                for c in range(3):
                    value = 0.0
                    for k in range(3):
                        value -= sums[p - first, r, k] * inverse[k, c]
                    inverse_lower[p, r, c] = value
            for r in range(3):
                for c in range(3):
                    for k in range(3):
                        own[r, c] -= inverse_lower[p, k, r] * lower[p, k, c]
        for r in range(3):
            for c in range(3):
                value = 0.0
                for k in range(3):
                    value += own[r, k] * inverse[k, c]
                inverse_diagonal[j, r, c] = value
