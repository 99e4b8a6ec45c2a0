"""Gauss-Newton steps against automatic derivatives, dense least squares, inverses and graphs solved by hand."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.graph.gauss_newton import (
    Factors,
    chain_nodes,
    gauss_newton_step,
    node_covariance,
    pick,
    relative_factors,
    step_information,
)
from ngo_estimator.loops.loop_closure import Loops
from tests.unit.ngo_estimator.samples import make_loops, meta_steps, with_origin

DOUBLE = torch.float64
BLOCKS = 9


def random_graph(seed: int = 0) -> tuple[Tensor, list[Factors]]:
    """Poses with origin of a small pose graph, and its factors: a chain with errors and four loops."""
    generator = torch.Generator().manual_seed(seed)
    poses = with_origin(se2.r2g(meta_steps(BLOCKS, seed)))
    loops = make_loops([0, 2, 1, 4], [8, 6, 8, 5], torch.randn(1, 4, 3, generator=generator, dtype=DOUBLE))
    step_std = 0.02 + 0.2 * torch.rand(1, BLOCKS, 3, generator=generator, dtype=DOUBLE)
    deviation = 0.1 * torch.randn(1, BLOCKS, 3, generator=generator, dtype=DOUBLE)
    information = 50.0 * torch.rand(1, 4, 3, generator=generator, dtype=DOUBLE)
    return poses, [
        chain_factors(poses, deviation, step_information(step_std)),
        loop_factors(loops, poses, information),
    ]


def chain_factors(poses: Tensor, deviation: Tensor, information: Tensor) -> Factors:
    """Those of relative poses that deviate so much from the measured ones."""
    return relative_factors(chain_nodes(deviation.shape[1]), poses, -deviation, information)


def loop_factors(loops: Loops, poses: Tensor, information: Tensor) -> Factors:
    start, end = (pick(poses, loops.nodes[..., k]) for k in (0, 1))
    residuals = se2.wrapped(loops.measured - se2.between(start, end))
    return relative_factors(loops.nodes, poses, residuals, information)


def dense(factors: list[Factors], nodes: int) -> tuple[Tensor, Tensor]:
    """Rows of the weighted least squares problem over all nodes but the first, and their right hand sides."""
    rows, right = [], []
    for f in factors:
        for k in range(f.nodes.shape[1]):
            row = torch.zeros(3, 3 * nodes, dtype=DOUBLE)
            for which in (0, 1):
                first = 3 * int(f.nodes[0, k, which])
                row[:, first : first + 3] = f.jacobian[0, k, :, 3 * which : 3 * which + 3]
            weight = f.information[0, k].sqrt()
            rows.append(weight[:, None] * row[:, 3:])
            right.append(weight * f.residual[0, k])
    return torch.cat(rows), torch.cat(right)


def test_jacobians_are_the_derivatives_of_what_is_predicted() -> None:
    poses, graph = random_graph()
    for factors in graph:
        start, end = factors.nodes[0].unbind(-1)
        exact = torch.autograd.functional.jacobian(lambda p, a=start, b=end: se2.between(p[a], p[b]), poses[0])
        for k in range(exact.shape[0]):
            expected = exact[k][:, factors.nodes[0, k]].flatten(1)
            assert torch.allclose(factors.jacobian[0, k], expected, atol=1e-10)


def test_a_step_is_the_solution_of_dense_least_squares() -> None:
    _, factors = random_graph()
    rows, right = dense(factors, BLOCKS + 1)
    expected = torch.linalg.lstsq(rows, right[:, None]).solution.unflatten(0, (-1, 3))[..., 0]
    step = gauss_newton_step(factors, BLOCKS + 1)[0]
    assert torch.equal(step[0], torch.zeros(3, dtype=DOUBLE))
    assert torch.allclose(step[1:], expected, rtol=1e-6, atol=1e-9)


def test_a_batch_is_the_single_graphs() -> None:
    graphs = [random_graph(seed)[1] for seed in (0, 1)]
    together = [
        Factors(*(torch.cat([getattr(graph[k], name) for graph in graphs]) for name in Factors.__dataclass_fields__))
        for k in (0, 1)
    ]
    batch = gauss_newton_step(together, BLOCKS + 1)
    for k, graph in enumerate(graphs):
        assert torch.allclose(batch[k], gauss_newton_step(graph, BLOCKS + 1)[0], atol=1e-12)


def test_a_square_that_does_not_close_is_closed_as_by_hand() -> None:
    # Four sides of 1 m with quarter turns, the last one 0.4 m too long; steps err in x alone, the loop is exact. The
    # gap lies along the second and fourth side, whose headings oppose each other: each takes half of it.
    steps = torch.tensor([[[1.0, 0.0, torch.pi / 2]] * 4], dtype=DOUBLE)
    steps[0, 3, 0] = 1.4
    poses = with_origin(se2.r2g(steps))
    assert torch.allclose(poses[0, 4, :2], torch.tensor([0.0, -0.4], dtype=DOUBLE), atol=1e-12)
    loops = make_loops([0], [3])  # the end is the start
    step_std = torch.tensor([0.1, 1e-5, 1e-5], dtype=DOUBLE).expand(1, 4, 3)
    information = torch.tensor([[[1e8, 1e8, 0.0]]], dtype=DOUBLE)
    factors = [
        chain_factors(poses, torch.zeros_like(steps), step_information(step_std)),
        loop_factors(loops, poses, information),
    ]
    after = poses + gauss_newton_step(factors, 5)
    correction = se2.g2r(after[:, 1:]) - steps
    expected = torch.tensor([0.0, 0.2, 0.0, -0.2], dtype=DOUBLE)
    assert torch.allclose(correction[0, :, 0], expected, atol=1e-4)
    assert correction[0, :, 1:].abs().max() < 1e-4
    assert after[0, 4, :2].norm() < 1e-4


def test_a_factor_of_information_zero_has_no_effect() -> None:
    _, (chain, pairs) = random_graph()
    kept = [0, 1, 3]
    fewer = Factors(*(getattr(pairs, name)[:, kept] for name in Factors.__dataclass_fields__))
    pairs.information[:, 2] = 0.0
    pairs.residual[:, 2] = 1e6
    without = gauss_newton_step([chain, fewer], BLOCKS + 1)
    assert torch.allclose(gauss_newton_step([chain, pairs], BLOCKS + 1), without, rtol=1e-9, atol=1e-12)


def test_gradients_are_those_of_finite_differences() -> None:
    poses, _ = random_graph()
    generator = torch.Generator().manual_seed(2)
    loops = make_loops([0, 2, 1], [8, 6, 8])
    deviation = 0.1 * torch.randn(1, BLOCKS, 3, generator=generator, dtype=DOUBLE)
    step_std = 0.1 + torch.rand(1, BLOCKS, 3, generator=generator, dtype=DOUBLE)
    residual = torch.randn(1, 3, 3, generator=generator, dtype=DOUBLE)
    information = torch.rand(1, 3, 3, generator=generator, dtype=DOUBLE)

    def step(poses: Tensor, deviation: Tensor, step_std: Tensor, residual: Tensor, information: Tensor) -> Tensor:
        factors = [
            chain_factors(poses, deviation, step_information(step_std)),
            relative_factors(loops.nodes, poses, residual, information),
        ]
        return gauss_newton_step(factors, BLOCKS + 1)

    inputs = tuple(value.requires_grad_() for value in (poses, deviation, step_std, residual, information))
    assert torch.autograd.gradcheck(step, inputs)


@pytest.mark.parametrize("loop_information", [0.0, 1e7])
def test_long_chains_with_unlike_deviations_are_solved(loop_information: float) -> None:
    blocks, count = 250, 96
    poses = with_origin(se2.r2g(meta_steps(blocks)))
    loops = make_loops([0] * count, [blocks - 1] * count)
    step_std = torch.full((1, blocks, 3), 20.0, dtype=DOUBLE)
    step_std[:, ::2] = 1e-3
    information = torch.full((1, count, 3), loop_information, dtype=DOUBLE)
    factors = [
        chain_factors(poses, torch.zeros_like(step_std), step_information(step_std)),
        loop_factors(loops, poses, information),
    ]
    step = gauss_newton_step(factors, blocks + 1)
    assert step.isfinite().all()
    assert bool(step.any()) == (loop_information > 0.0)


def test_a_nodes_covariance_is_its_block_of_the_inverse_of_the_information_matrix() -> None:
    _, factors = random_graph()
    rows, _ = dense(factors, BLOCKS + 1)
    inverse = torch.linalg.inv(rows.mT @ rows)
    for node in (1, 5, BLOCKS):
        first = 3 * (node - 1)
        expected = inverse[first : first + 3, first : first + 3]
        assert torch.allclose(node_covariance(factors, BLOCKS + 1, node)[0], expected, rtol=1e-6)
    # Less is known without the loops.
    alone = node_covariance(factors[:1], BLOCKS + 1, BLOCKS)[0]
    assert torch.linalg.eigvalsh(alone - node_covariance(factors, BLOCKS + 1, BLOCKS)[0]).min() > 0.0


# ---- whole information matrices


def whole_information(count: int, seed: int = 5) -> Tensor:
    """Random positive definite matrices ``(1, count, 3, 3)``, float64."""
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(1, count, 3, 3, generator=generator, dtype=DOUBLE)
    return 20.0 * root @ root.mT + torch.eye(3, dtype=DOUBLE)


def with_whole_information(factors: list[Factors]) -> list[Factors]:
    return [replace(f, information=whole_information(f.nodes.shape[1], k)) for k, f in enumerate(factors)]


def test_diagonal_matrices_are_their_diagonals() -> None:
    _, factors = random_graph()
    whole = [replace(f, information=torch.diag_embed(f.information)) for f in factors]
    expected = gauss_newton_step(factors, BLOCKS + 1)
    torch.testing.assert_close(gauss_newton_step(whole, BLOCKS + 1), expected, rtol=1e-10, atol=1e-12)
    # One kind of factors may have matrices while the other has diagonals.
    torch.testing.assert_close(gauss_newton_step([whole[0], factors[1]], BLOCKS + 1), expected, rtol=1e-10, atol=1e-12)


def test_a_step_with_whole_information_is_the_solution_of_dense_least_squares() -> None:
    _, factors = random_graph()
    factors = with_whole_information(factors)
    rows, right = [], []
    for f in factors:
        for k in range(f.nodes.shape[1]):
            row = torch.zeros(3, 3 * (BLOCKS + 1), dtype=DOUBLE)
            for which in (0, 1):
                first = 3 * int(f.nodes[0, k, which])
                row[:, first : first + 3] = f.jacobian[0, k, :, 3 * which : 3 * which + 3]
            root = torch.linalg.cholesky(f.information[0, k]).mT
            rows.append(root @ row[:, 3:])
            right.append(root @ f.residual[0, k])
    matrix = torch.cat(rows)
    expected = torch.linalg.lstsq(matrix, torch.cat(right)[:, None]).solution.unflatten(0, (-1, 3))[..., 0]
    torch.testing.assert_close(gauss_newton_step(factors, BLOCKS + 1)[0, 1:], expected, rtol=1e-6, atol=1e-9)
    covariance = torch.linalg.inv(matrix.mT @ matrix)[-3:, -3:]
    torch.testing.assert_close(node_covariance(factors, BLOCKS + 1, BLOCKS)[0], covariance, rtol=1e-6, atol=0.0)


def test_a_loop_that_knows_nothing_along_a_corridor_moves_nothing_along_it() -> None:
    # One step of 1 m; the loop tells where its end lies across a corridor of 45 degrees, and no more.
    poses = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]], dtype=DOUBLE)
    across = torch.tensor([-math.sqrt(0.5), math.sqrt(0.5), 0.0], dtype=DOUBLE)
    residual = torch.tensor([[[0.3, 0.7, 0.0]]], dtype=DOUBLE)
    nodes = torch.tensor([[[0, 1]]])
    factors = [
        chain_factors(poses, torch.zeros_like(poses[:, 1:]), torch.ones(1, 1, 3, dtype=DOUBLE)),
        relative_factors(nodes, poses, residual, 1e9 * torch.outer(across, across)[None, None]),
    ]
    step = gauss_newton_step(factors, 2)[0, 1]
    torch.testing.assert_close(step @ across, residual[0, 0] @ across, rtol=1e-6, atol=1e-6)
    along = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0.0], dtype=DOUBLE)
    assert abs((step @ along).item()) < 1e-6


def test_gradients_of_whole_information_are_those_of_finite_differences() -> None:
    poses, factors = random_graph()
    roots = [torch.linalg.cholesky(whole_information(f.nodes.shape[1], k)) for k, f in enumerate(factors)]
    residuals = [f.residual.clone() for f in factors]
    loops = factors[1].nodes

    def step(poses: Tensor, deviation: Tensor, residual: Tensor, chain_root: Tensor, loop_root: Tensor) -> Tensor:
        parts = [
            chain_factors(poses, deviation, chain_root @ chain_root.mT),
            relative_factors(loops, poses, residual, loop_root @ loop_root.mT),
        ]
        return gauss_newton_step(parts, BLOCKS + 1)

    inputs = tuple(value.requires_grad_() for value in (poses, -residuals[0], residuals[1], *roots))
    assert torch.autograd.gradcheck(step, inputs)


@pytest.mark.parametrize("shape", [(1, 4, 1), (1, 4, 3, 1), (1, 3, 3), (1, 3, 3, 3)])
def test_information_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    _, (_, pairs) = random_graph()
    with pytest.raises(ValueError, match=r"information is of shape .*; expected \(1, 4, 3\) or \(1, 4, 3, 3\)"):
        replace(pairs, information=torch.zeros(shape))
