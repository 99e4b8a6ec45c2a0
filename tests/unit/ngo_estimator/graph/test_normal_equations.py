"""The sparse normal equations against the dense ones."""

import numpy as np
import pytest
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.graph.gauss_newton import Factors, gauss_newton_step, node_covariance, pick
from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations
from tests.unit.ngo_estimator.graph.test_gauss_newton import BLOCKS, random_graph, with_whole_information
from tests.unit.ngo_estimator.samples import optimized, small_optimizer, trajectory_inputs


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


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_steps_and_covariances_are_the_dense_ones(seed: int) -> None:
    poses, factors = random_graph(seed)
    sparse = equations(poses, factors)
    assert_same_step(sparse, factors)
    for node in (1, 5, BLOCKS):
        expected = node_covariance(factors, BLOCKS + 1, node)[0].numpy()
        np.testing.assert_allclose(sparse.covariance([node]), expected, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize("seed", [0, 1])
def test_whole_information_is_solved_as_by_the_dense_solver(seed: int) -> None:
    poses, factors = random_graph(seed)
    factors = with_whole_information(factors)
    sparse = equations(poses, factors)
    assert_same_step(sparse, factors)
    expected = node_covariance(factors, BLOCKS + 1, BLOCKS)[0].numpy()
    np.testing.assert_allclose(sparse.covariance([BLOCKS]), expected, rtol=1e-8, atol=1e-14)


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
