"""The loops' linear system against dense Jacobians, least squares, inverses and a graph solved by hand."""

import pytest
import torch
from torch import Tensor

from ngo_estimator import se2
from ngo_estimator.loop_closure import Loops, loop_residuals
from ngo_estimator.loop_system import LoopSystem, end_covariance, gauss_newton_correction
from tests.unit.ngo_estimator.samples import make_loops, meta_steps, with_origin

DOUBLE = torch.float64
BLOCKS, LOOPS = 9, 5


def random_problem(seed: int = 0) -> tuple[Tensor, Loops, Tensor, Tensor, Tensor]:
    """Poses with origin, loops, residuals, step deviations and informations of a small pose graph."""
    generator = torch.Generator().manual_seed(seed)
    poses = with_origin(se2.r2g(meta_steps(BLOCKS, seed)))
    measured = torch.randn(1, LOOPS, 3, generator=generator, dtype=DOUBLE)
    loops = make_loops([0, 2, 1, 0, 4], [8, 6, 8, 2, 5], measured)
    step_std = 0.02 + 0.2 * torch.rand(1, BLOCKS, 3, generator=generator, dtype=DOUBLE)
    information = 50.0 * torch.rand(1, LOOPS, 3, generator=generator, dtype=DOUBLE)
    return poses, loops, loop_residuals(loops, poses), step_std, information


def dense_jacobian(loops: Loops, poses: Tensor) -> Tensor:
    """Derivative ``(3 loops, 3 blocks)`` of the ends by the meta-steps on the loops, by automatic differentiation."""
    relative = se2.g2r(poses[0, 1:])

    def end_poses(steps: Tensor) -> Tensor:
        return with_origin(se2.r2g(steps[None]))[0, loops.end[0] + 1]

    jacobian = torch.autograd.functional.jacobian(end_poses, relative)
    index = torch.arange(relative.shape[0])
    on_loop = (index >= loops.start[0, :, None]) & (index <= loops.end[0, :, None])
    return (jacobian * on_loop[:, None, :, None]).reshape(3 * loops.start.shape[1], -1)


def system_of(loops: Loops, poses: Tensor) -> LoopSystem:
    return LoopSystem(loops.start, loops.end, poses)


def test_products_are_those_with_the_derivative_of_the_end_poses_on_the_loops() -> None:
    poses, loops, _, step_std, _ = random_problem()
    system, jacobian = system_of(loops, poses), dense_jacobian(loops, poses)
    generator = torch.Generator().manual_seed(3)
    steps = torch.randn(1, BLOCKS, 3, generator=generator, dtype=DOUBLE)
    ends = torch.randn(1, LOOPS, 3, generator=generator, dtype=DOUBLE)
    assert torch.allclose(system.moved(steps).flatten(), jacobian @ steps.flatten(), atol=1e-12)
    assert torch.allclose(system.pulled(ends).flatten(), jacobian.mT @ ends.flatten(), atol=1e-12)
    dense = jacobian @ torch.diag(step_std.flatten().square()) @ jacobian.mT
    by_component = torch.arange(3 * LOOPS).reshape(LOOPS, 3).mT.flatten()  # all x first, then all y, then headings
    covariance = system.covariance(step_std.square())[0]
    assert torch.allclose(covariance, dense[by_component][:, by_component], atol=1e-12)
    assert torch.allclose(system.variances(step_std.square()).flatten(), dense.diagonal(), atol=1e-12)
    # Two of the loops share no meta-step.
    apart = torch.arange(3) * LOOPS
    assert not covariance[apart + 3][:, apart + 4].any()


def test_a_batch_is_the_single_trajectories() -> None:
    first, second = random_problem(0), random_problem(1)
    together = [torch.cat(pair) for pair in zip(
        (first[0], first[1].start, first[1].end, *first[2:]),
        (second[0], second[1].start, second[1].end, *second[2:]), strict=True)]  # fmt: skip
    poses, start, end, residuals, step_std, information = together
    none = torch.zeros_like(step_std)
    batch = gauss_newton_correction(LoopSystem(start, end, poses), residuals, step_std, information, none)
    for k in range(2):
        one = slice(k, k + 1)
        alone = gauss_newton_correction(
            LoopSystem(start[one], end[one], poses[one]), residuals[one], step_std[one], information[one], none[one]
        )
        assert torch.allclose(batch[one], alone, atol=1e-12)


@pytest.mark.parametrize("deviated", [False, True])
def test_correction_is_that_of_dense_least_squares(deviated: bool) -> None:
    poses, loops, residuals, step_std, information = random_problem()
    blocks = step_std.shape[1]
    deviation = torch.zeros_like(step_std)
    if deviated:
        deviation = 0.1 * torch.randn(1, blocks, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    result = gauss_newton_correction(system_of(loops, poses), residuals, step_std, information, deviation)
    dense = dense_jacobian(loops, poses)
    target = residuals.flatten() + dense @ deviation.flatten()
    rows = torch.cat((torch.diag(1.0 / step_std.flatten()), information.flatten().sqrt()[:, None] * dense))
    right = torch.cat((torch.zeros(3 * blocks, dtype=DOUBLE), information.flatten().sqrt() * target))
    expected = torch.linalg.lstsq(rows, right).solution
    assert torch.allclose(result.flatten(), expected, rtol=1e-6, atol=1e-9)


def test_a_square_that_does_not_close_is_closed_as_by_hand() -> None:
    # Four sides of 1 m with quarter turns, the last one 0.4 m too long; steps err in x alone, the loop is exact. The
    # gap lies along the second and fourth side, whose headings oppose each other: each takes half of it.
    steps = torch.tensor([[[1.0, 0.0, torch.pi / 2]] * 4], dtype=DOUBLE)
    steps[0, 3, 0] = 1.4
    poses = with_origin(se2.r2g(steps))
    assert torch.allclose(poses[0, 4, :2], torch.tensor([0.0, -0.4], dtype=DOUBLE), atol=1e-12)
    loops = make_loops([0], [3])  # the end is the start
    step_std = torch.tensor([0.1, 1e-9, 1e-9], dtype=DOUBLE).expand(1, 4, 3)
    information = torch.tensor([[[1e8, 1e8, 0.0]]], dtype=DOUBLE)
    correction = gauss_newton_correction(
        system_of(loops, poses), loop_residuals(loops, poses), step_std, information, torch.zeros_like(steps)
    )
    expected = torch.tensor([0.0, 0.2, 0.0, -0.2], dtype=DOUBLE)
    assert torch.allclose(correction[0, :, 0], expected, atol=1e-5)
    assert correction[0, :, 1:].abs().max() < 1e-6
    assert with_origin(se2.r2g(steps + correction))[0, 4, :2].norm() < 1e-5


def test_a_loop_of_information_zero_has_exactly_no_effect() -> None:
    poses, loops, residuals, step_std, information = random_problem()
    none = torch.zeros_like(step_std)
    information[:, 2] = 0.0
    kept = [0, 1, 3, 4]
    fewer = LoopSystem(loops.start[:, kept], loops.end[:, kept], poses)
    without = gauss_newton_correction(fewer, residuals[:, kept], step_std, information[:, kept], none)
    residuals[:, 2] = 1e3
    system = system_of(loops, poses)
    assert torch.allclose(gauss_newton_correction(system, residuals, step_std, information, none), without, atol=1e-12)
    nothing = gauss_newton_correction(system, residuals, step_std, torch.zeros_like(information), none)
    assert torch.equal(nothing, torch.zeros_like(nothing))


def test_gradients_are_finite_where_information_is_zero_and_right_elsewhere() -> None:
    poses, loops, residuals, step_std, information = random_problem()
    deviation = 0.1 * torch.ones_like(step_std)
    information.requires_grad_()
    partly = information * torch.tensor([1.0, 0.0, 1.0], dtype=DOUBLE)
    gauss_newton_correction(system_of(loops, poses), residuals, step_std, partly, deviation).square().sum().backward()
    assert information.grad is not None and information.grad.isfinite().all()
    assert torch.autograd.gradcheck(
        lambda p, r, s, w, d: gauss_newton_correction(system_of(loops, p), r, s, w, d),
        tuple(v.detach().requires_grad_() for v in (poses, residuals, step_std, information + 1.0, deviation)),
    )


def test_many_precise_loops_between_the_same_poses_are_solved() -> None:
    blocks, count = 40, 96
    poses = with_origin(se2.r2g(meta_steps(blocks))).float()
    loops = make_loops([0] * count, [blocks - 1] * count, torch.zeros(1, count, 3, dtype=DOUBLE))
    residuals = loop_residuals(loops, poses.double()).float()
    step_std, information = torch.full((1, blocks, 3), 20.0), torch.full((1, count, 3), 1e7)
    correction = gauss_newton_correction(
        system_of(loops, poses), residuals, step_std, information, torch.zeros(1, blocks, 3)
    )
    assert correction.isfinite().all()


def test_end_covariance_is_the_inverse_of_the_information_matrix() -> None:
    poses, loops, _, step_std, information = random_problem()
    dense, to_end = dense_jacobian(loops, poses), dense_jacobian(make_loops([0], [BLOCKS - 1]), poses)
    precision = torch.diag(step_std.flatten() ** -2) + dense.mT @ (information.flatten()[:, None] * dense)
    expected = to_end @ torch.linalg.inv(precision) @ to_end.mT
    ends = loops.start, loops.end
    assert torch.allclose(end_covariance(ends, poses, step_std, information)[0], expected, rtol=1e-6)
    # Less is known without the loops.
    nothing = end_covariance(None, poses, step_std, None)[0]
    assert torch.allclose(nothing, to_end @ torch.diag(step_std.flatten() ** 2) @ to_end.mT)
    assert torch.equal(end_covariance(ends, poses, step_std, torch.zeros_like(information))[0], nothing)
    assert torch.linalg.eigvalsh(nothing - expected).min() > -1e-12


def test_end_covariance_stays_positive_with_very_precise_loops() -> None:
    blocks, count = 60, 50
    poses = with_origin(se2.r2g(meta_steps(blocks)))
    loops = make_loops([0] * count, [blocks - 1] * count)
    step_std = torch.full((1, blocks, 3), 0.5, dtype=DOUBLE)
    information = torch.full((1, count, 3), 1e8, dtype=DOUBLE)
    covariance = end_covariance((loops.start, loops.end), poses, step_std, information)[0]
    assert torch.linalg.eigvalsh(covariance).min() > 0.0
    assert torch.allclose(covariance, torch.eye(3, dtype=DOUBLE) / (count * 1e8), rtol=0.1, atol=1e-12)
