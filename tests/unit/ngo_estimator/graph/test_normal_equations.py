"""Normal equations of a pose graph and their sparse Cholesky factors, against dense ones."""

import numpy as np
import pytest
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.graph.block_cholesky import BlockCholesky, BlockStructure, placed
from ngo_estimator.graph.corrector import normal_equations
from ngo_estimator.graph.gauss_newton import Factors, gauss_newton_step, node_covariance, pick
from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations
from tests.unit.ngo_estimator.graph.test_corrector import STD, loop, straight
from tests.unit.ngo_estimator.graph.test_gauss_newton import BLOCKS, random_graph, with_whole_information
from tests.unit.ngo_estimator.samples import optimized, small_optimizer, trajectory_inputs


def problem(count: int, loops: int, seed: int) -> tuple[np.ndarray, BlockStructure, np.ndarray, np.ndarray]:
    """A random positive definite matrix over a chain with loops, dense, and as blocks."""
    generator = np.random.default_rng(seed)
    index = np.arange(count - 1)
    pairs = np.concatenate((np.stack((index, index + 1), axis=1), generator.integers(0, count, (loops, 2))))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    structure = BlockStructure(pairs, count)
    matrix, diagonal, lower = np.eye(3 * count), np.zeros((count, 3, 3)), np.zeros((structure.blocks, 3, 3))
    diagonal += np.eye(3)
    ranks, place = placed(pairs, structure.rank, structure.starts, structure.rows)
    for k, pair in enumerate(pairs):
        jacobian = generator.normal(size=(3, 6))
        part = jacobian.T @ jacobian
        rows = (3 * pair[:, None] + np.arange(3)).ravel()
        matrix[np.ix_(rows, rows)] += part
        diagonal[structure.rank[pair[0]]] += part[:3, :3]
        diagonal[structure.rank[pair[1]]] += part[3:, 3:]
        lower[place[k]] += part[:3, 3:] if ranks[k, 0] > ranks[k, 1] else part[3:, :3]
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
    steps = straight(3, loop(3.0, (STD, STD, STD))).steps
    with pytest.raises(ValueError, match="a pair has no factor"):
        normal_equations(np.zeros((4, 3)), (steps, np.ones(3))).pair_covariances(np.array([[1, 3]]))


def test_an_order_that_means_too_much_work_is_not_found_to_its_end() -> None:
    """A chain of 300 rows has 299 columns of one block: 299 blocks are multiplied."""
    pairs = problem(300, 0, seed=0)[1].pairs
    assert BlockStructure(pairs, 300, most_work=299).complete and not BlockStructure(pairs, 300, most_work=298).complete


def equations(poses: Tensor, factors: list[Factors], structure: GraphStructure | None = None) -> NormalEquations:
    nodes = torch.cat([f.nodes for f in factors], dim=1)
    between = se2.between(pick(poses, nodes[..., 0]), pick(poses, nodes[..., 1]))
    relative = between + torch.cat([f.residual for f in factors], dim=1)
    whole = [f.information if f.information.dim() == 4 else torch.diag_embed(f.information) for f in factors]
    information = torch.cat(whole, dim=1)[0].numpy()
    structure = structure or GraphStructure(nodes[0].numpy(), BLOCKS + 1)
    return NormalEquations(structure, poses[0].numpy(), relative[0].numpy(), information)


def assert_same_step(sparse: NormalEquations, factors: list[Factors], rtol: float = 1e-9) -> None:
    dense = gauss_newton_step(factors, BLOCKS + 1)[0].numpy()
    np.testing.assert_allclose(sparse.solution(), dense, rtol=rtol, atol=1e-12)


@pytest.mark.parametrize(("seed", "whole"), [(0, False), (1, False), (2, False), (0, True), (1, True)])
def test_steps_and_covariances_are_the_dense_ones(seed: int, whole: bool) -> None:
    poses, factors = random_graph(seed)
    factors = with_whole_information(factors) if whole else factors
    sparse = equations(poses, factors)
    assert_same_step(sparse, factors)
    for node in (1, 5, BLOCKS):
        expected = node_covariance(factors, BLOCKS + 1, node)[0].numpy()
        np.testing.assert_allclose(sparse.covariance([node]), expected, rtol=1e-8, atol=1e-14)


def test_the_joint_covariance_holds_those_of_single_poses_in_the_order_asked_for() -> None:
    poses, factors = random_graph()
    sparse = equations(poses, factors)
    joint = sparse.covariance([7, 2])
    np.testing.assert_allclose(joint[:3, :3], sparse.covariance([7]), rtol=1e-9)
    np.testing.assert_allclose(joint[3:, 3:], sparse.covariance([2]), rtol=1e-9)
    np.testing.assert_array_equal(joint, joint.T)
    assert np.abs(joint[:3, 3:]).max() > 0.0
    assert np.linalg.eigvalsh(joint)[0] > 0.0


def test_one_structure_serves_all_steps_of_an_optimisation() -> None:
    poses, factors = random_graph()
    structure = GraphStructure(torch.cat([f.nodes[0] for f in factors]).numpy(), BLOCKS + 1)
    for gain in (1.0, 0.1, 1e-6):
        weaker = [
            factors[0],
            Factors(factors[1].nodes, factors[1].jacobian, factors[1].residual, gain * factors[1].information),
        ]
        assert_same_step(equations(poses, weaker, structure), weaker, rtol=1e-8)


@pytest.mark.parametrize("form", ["loops", "gauss_newton"])
def test_with_and_without_gradients_the_optimizer_gives_the_same(form: str) -> None:
    optimizer, inputs = small_optimizer(form, trained=True), trajectory_inputs(1, 160)
    with torch.no_grad():
        sparse = optimized(optimizer, inputs)
    dense = optimized(optimizer, inputs)
    assert sparse.equations is not None and dense.equations is None
    assert torch.allclose(sparse.poses, dense.poses, atol=1e-5)
    assert not torch.allclose(sparse.meta_relative[-1], sparse.meta_relative[0], atol=1e-4)
    # The sparse one is linearised before the last step, which random weights leave large.
    optimizer = small_optimizer(form, iterations=10)
    with torch.no_grad():
        sparse = optimized(optimizer, inputs)
    dense = optimized(optimizer, inputs)
    ends = [result.end_covariance()[0].diagonal() for result in (sparse, dense)]
    assert torch.allclose(ends[0], ends[1], rtol=0.1)
