"""The sparse Cholesky factorisation against numpy's dense one."""

import numpy as np
import pytest

from ngo_estimator.graph.block_cholesky import BlockCholesky, BlockStructure


def problem(count: int, loops: int, seed: int) -> tuple[np.ndarray, BlockStructure, np.ndarray, np.ndarray]:
    """A random positive definite matrix over a chain with loops, dense, and as blocks."""
    generator = np.random.default_rng(seed)
    index = np.arange(count - 1)
    pairs = np.concatenate((np.stack((index, index + 1), axis=1), generator.integers(0, count, (loops, 2))))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    structure = BlockStructure(pairs, count)
    matrix, diagonal, lower = np.eye(3 * count), np.zeros((count, 3, 3)), np.zeros((structure.blocks, 3, 3))
    diagonal += np.eye(3)
    place, first_is_row = structure.places(pairs)
    for k, pair in enumerate(pairs):
        jacobian = generator.normal(size=(3, 6))
        part = jacobian.T @ jacobian
        rows = (3 * pair[:, None] + np.arange(3)).ravel()
        matrix[np.ix_(rows, rows)] += part
        diagonal[structure.rank[pair[0]]] += part[:3, :3]
        diagonal[structure.rank[pair[1]]] += part[3:, 3:]
        lower[place[k]] += part[:3, 3:] if first_is_row[k] else part[3:, :3]
    return matrix, structure, diagonal, lower


@pytest.mark.parametrize(("count", "loops"), [(1, 0), (2, 0), (9, 4), (64, 0), (65, 40), (200, 300)])
def test_solutions_are_the_dense_ones(count: int, loops: int) -> None:
    matrix, structure, diagonal, lower = problem(count, loops, seed=count)
    right = np.random.default_rng(1).normal(size=(count, 3, 4))
    solution = BlockCholesky(structure, diagonal, lower).solve(right)
    np.testing.assert_allclose(solution.reshape(-1, 4), np.linalg.solve(matrix, right.reshape(-1, 4)), rtol=1e-9)


def test_a_chain_fills_no_block_beside_its_own() -> None:
    assert problem(300, 0, seed=0)[1].blocks == 299


def test_the_order_does_not_depend_on_how_the_pairs_are_told() -> None:
    _, structure, _, _ = problem(80, 60, seed=3)
    again = BlockStructure(np.concatenate((structure.pairs[::-1, ::-1], structure.pairs[:9])), 80)
    np.testing.assert_array_equal(again.rank, structure.rank)
    np.testing.assert_array_equal(again.rows, structure.rows)


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    _, structure, diagonal, lower = problem(40, 20, seed=4)
    for wrong in (0.0, -1.0, np.nan):
        broken = diagonal.copy()
        broken[structure.rank[17]] = wrong
        with pytest.raises(ArithmeticError, match="the matrix is not positive definite in row"):
            BlockCholesky(structure, broken, lower.copy())


def test_rows_and_pairs_that_are_not_there_are_refused() -> None:
    with pytest.raises(ValueError, match="pairs join rows 0 to 5; expected 0 to 4"):
        BlockStructure(np.array([[0, 5]]), 5)
    with pytest.raises(ValueError, match="a pair has no block"):
        BlockStructure(np.array([[0, 1], [2, 3]]), 4).places(np.array([[0, 3]]))
