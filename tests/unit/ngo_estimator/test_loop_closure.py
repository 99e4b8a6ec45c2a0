"""Loop closures against dense least squares, automatic derivatives, inverses of information matrices, plain loops."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from ngo_estimator import se2
from ngo_estimator.loop_closure import (
    Loops,
    end_covariance,
    find_loops,
    gauss_newton_correction,
    loop_jacobian,
    loop_residuals,
    spread_over_span,
)
from ngo_estimator.place_encoder import PairHead, PlaceConfig
from ngo_estimator.pose_aggregation import poses_in_blocks
from tests.unit.ngo_estimator.samples import place_config

DOUBLE = torch.float64


def make_loops(start: list[int], end: list[int], measured: Tensor | None = None) -> Loops:
    """One trajectory's loops, in float64."""
    count = len(start)
    indices = torch.tensor([start]), torch.tensor([end]), torch.tensor([start])
    measured = torch.zeros(1, count, 3, dtype=DOUBLE) if measured is None else measured
    number = torch.zeros(1, count, dtype=DOUBLE)
    return Loops(*indices, measured, torch.zeros(1, count, 2, dtype=DOUBLE), number, number, number == 0.0)


def with_origin(poses: Tensor) -> Tensor:
    return torch.cat((torch.zeros_like(poses[:, :1]), poses), dim=1)


def meta_steps(blocks: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(1, blocks, 3, generator=generator, dtype=DOUBLE)
    return values * torch.tensor([0.3, 0.1, 0.4]) + torch.tensor([0.8, 0.0, 0.1])


def random_problem() -> tuple[Tensor, Loops, Tensor, Tensor, Tensor]:
    """Poses with origin, loops, residuals, step deviations and informations of a small pose graph."""
    generator = torch.Generator().manual_seed(5)
    poses = with_origin(se2.r2g(meta_steps(9)))
    loops = make_loops([0, 2, 1, 4], [8, 6, 8, 5], torch.randn(1, 4, 3, generator=generator, dtype=DOUBLE))
    step_std = 0.02 + 0.2 * torch.rand(1, 9, 3, generator=generator, dtype=DOUBLE)
    information = 50.0 * torch.rand(1, 4, 3, generator=generator, dtype=DOUBLE)
    return poses, loops, loop_residuals(loops, poses), step_std, information


def test_residual_is_measured_less_current_along_the_map() -> None:
    relative = meta_steps(6)
    poses = with_origin(se2.r2g(relative))
    exact = se2.between(poses[:, 1], poses[:, 5])
    assert loop_residuals(make_loops([1], [4], exact[:, None]), poses).abs().max() < 1e-12
    # The measurement says: 0.2 m further in the direction in which the start looks, and 0.1 rad more to the left.
    more = exact + torch.tensor([0.2, 0.0, 0.1], dtype=DOUBLE)
    x, y, yaw = loop_residuals(make_loops([1], [4], more[:, None]), poses)[0, 0]
    heading = poses[0, 1, 2]
    assert torch.allclose(
        torch.stack((x, y, yaw)), torch.stack((0.2 * heading.cos(), 0.2 * heading.sin(), yaw * 0 + 0.1))
    )


def test_heading_residual_is_wrapped() -> None:
    poses = torch.zeros(1, 3, 3, dtype=DOUBLE)
    poses[0, 2, 2] = 6.0
    measured = torch.tensor([[[0.0, 0.0, -0.1]]], dtype=DOUBLE)
    assert loop_residuals(make_loops([0], [1], measured), poses)[0, 0, 2].item() == pytest.approx(2 * torch.pi - 6.1)


def test_jacobian_is_the_derivative_of_the_end_pose_on_the_loop_and_zero_elsewhere() -> None:
    relative = meta_steps(7)
    loops = make_loops([0, 2, 5, 6], [6, 4, 5, 6])

    def end_poses(steps: Tensor) -> Tensor:
        return with_origin(se2.r2g(steps[None]))[0, loops.end[0] + 1]

    exact = torch.autograd.functional.jacobian(end_poses, relative[0])
    result = loop_jacobian(loops, with_origin(se2.r2g(relative)))[0]
    for number, (start, end) in enumerate(zip(loops.start[0].tolist(), loops.end[0].tolist(), strict=True)):
        on_loop = slice(start, end + 1)
        assert torch.allclose(result[number][:, on_loop], exact[number][:, on_loop], atol=1e-12)
        result[number][:, on_loop] = 0.0
    assert not result.any()


@pytest.mark.parametrize("deviated", [False, True])
def test_correction_is_that_of_dense_least_squares(deviated: bool) -> None:
    poses, loops, residuals, step_std, information = random_problem()
    blocks = step_std.shape[1]
    deviation = torch.zeros_like(step_std)
    if deviated:
        deviation = 0.1 * torch.randn(1, blocks, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    jacobian = loop_jacobian(loops, poses)
    result = gauss_newton_correction(jacobian, residuals, step_std, information, deviation)
    dense = jacobian.reshape(12, 3 * blocks)
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
    residuals, jacobian = loop_residuals(loops, poses), loop_jacobian(loops, poses)
    correction = gauss_newton_correction(jacobian, residuals, step_std, information, torch.zeros_like(steps))
    expected = torch.tensor([0.0, 0.2, 0.0, -0.2], dtype=DOUBLE)
    assert torch.allclose(correction[0, :, 0], expected, atol=1e-5)
    assert correction[0, :, 1:].abs().max() < 1e-6
    assert with_origin(se2.r2g(steps + correction))[0, 4, :2].norm() < 1e-5


def test_a_loop_of_information_zero_has_exactly_no_effect() -> None:
    poses, loops, residuals, step_std, information = random_problem()
    jacobian, none = loop_jacobian(loops, poses), torch.zeros_like(step_std)
    information[:, 2] = 0.0
    kept = [0, 1, 3]
    without = gauss_newton_correction(jacobian[:, kept], residuals[:, kept], step_std, information[:, kept], none)
    residuals[:, 2] = 1e3
    jacobian[:, 2] *= 100.0
    assert torch.allclose(
        gauss_newton_correction(jacobian, residuals, step_std, information, none), without, atol=1e-12
    )
    nothing = gauss_newton_correction(jacobian, residuals, step_std, torch.zeros_like(information), none)
    assert torch.equal(nothing, torch.zeros_like(nothing))


def test_gradients_are_finite_where_information_is_zero_and_right_elsewhere() -> None:
    poses, loops, residuals, step_std, information = random_problem()
    jacobian, deviation = loop_jacobian(loops, poses), 0.1 * torch.ones_like(step_std)
    information.requires_grad_()
    result = gauss_newton_correction(
        jacobian, residuals, step_std, information * torch.tensor([1.0, 0.0, 1.0], dtype=DOUBLE), deviation
    )
    result.square().sum().backward()
    assert information.grad is not None and information.grad.isfinite().all()
    assert torch.autograd.gradcheck(
        lambda r, s, w, d: gauss_newton_correction(jacobian, r, s, w, d),
        tuple(v.detach().requires_grad_() for v in (residuals, step_std, information.detach() + 1.0, deviation)),
    )


def test_many_precise_loops_between_the_same_poses_are_solved_in_float32() -> None:
    blocks, count = 40, 96
    poses = with_origin(se2.r2g(meta_steps(blocks))).float()
    loops = make_loops([0] * count, [blocks - 1] * count, torch.zeros(1, count, 3, dtype=DOUBLE))
    loops = replace(loops, measured=loops.measured.float())
    residuals = loop_residuals(loops, poses)
    step_std = torch.full((1, blocks, 3), 20.0)
    correction = gauss_newton_correction(
        loop_jacobian(loops, poses), residuals, step_std, torch.full((1, count, 3), 1e7), torch.zeros(1, blocks, 3)
    )
    assert correction.isfinite().all()


def test_end_covariance_is_the_inverse_of_the_information_matrix() -> None:
    poses, loops, _, step_std, information = random_problem()
    jacobian, blocks = loop_jacobian(loops, poses), step_std.shape[1]
    dense = jacobian.reshape(12, 3 * blocks)
    precision = torch.diag(step_std.flatten() ** -2) + dense.mT @ (information.flatten()[:, None] * dense)
    to_end = loop_jacobian(make_loops([0], [blocks - 1]), poses).reshape(3, 3 * blocks)
    expected = to_end @ torch.linalg.inv(precision) @ to_end.mT
    assert torch.allclose(end_covariance(poses, jacobian, step_std, information)[0], expected, rtol=1e-6)
    # Less is known without the loops.
    nothing = end_covariance(poses, jacobian, step_std, torch.zeros_like(information))[0]
    assert torch.allclose(nothing, to_end @ torch.diag(step_std.flatten() ** 2) @ to_end.mT)
    assert torch.linalg.eigvalsh(nothing - expected).min() > -1e-12


def test_end_covariance_stays_positive_with_very_precise_loops() -> None:
    blocks, count = 60, 50
    poses = with_origin(se2.r2g(meta_steps(blocks)))
    loops = make_loops([0] * count, [blocks - 1] * count)
    step_std = torch.full((1, blocks, 3), 0.5, dtype=DOUBLE)
    information = torch.full((1, count, 3), 1e8, dtype=DOUBLE)
    covariance = end_covariance(poses, loop_jacobian(loops, poses), step_std, information)[0]
    assert torch.linalg.eigvalsh(covariance).min() > 0.0
    assert torch.allclose(covariance, torch.eye(3, dtype=DOUBLE) / (count * 1e8), rtol=0.1, atol=1e-12)


def test_spread_is_the_weighted_mean_over_the_loops_on_each_step() -> None:
    loops = make_loops([0, 2, 3, 7], [5, 4, 9, 7])
    values, weights = torch.randn(1, 4, 3, dtype=DOUBLE), torch.tensor([[0.7, 0.2, 1.0, 0.5]], dtype=DOUBLE)
    spread, support = spread_over_span(loops, values, weights, 11)
    for step in range(11):
        total, sum_weights = torch.zeros(3, dtype=DOUBLE), 0.0
        for number, (start, end) in enumerate(zip(loops.start[0].tolist(), loops.end[0].tolist(), strict=True)):
            if start <= step <= end:
                total += weights[0, number] * values[0, number] / (end - start + 1)
                sum_weights += weights[0, number].item()
        assert torch.allclose(spread[0, step], total / (sum_weights + 1e-3), atol=1e-12)
        assert support[0, step].item() == pytest.approx(sum_weights, abs=1e-12)


def test_loops_of_weight_zero_spread_nothing() -> None:
    spread, support = spread_over_span(
        make_loops([0, 1], [4, 3]), torch.randn(1, 2, 3, dtype=DOUBLE), torch.zeros(1, 2, dtype=DOUBLE), 6
    )
    assert not spread.any() and not support.any()


# ---- finding loops


class Identity(PairHead):
    """Embeds by normalising, and believes in a pair as far as its codes agree; it always measures the same motion."""

    def __init__(self, config: PlaceConfig) -> None:
        super().__init__(config)
        self.embedding = nn.Identity()  # type: ignore[assignment]

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        agreement = (nn.functional.normalize(a, dim=-1) * nn.functional.normalize(b, dim=-1)).sum(-1)
        measured = torch.tensor([0.1, -0.2, 0.3]).expand(*a.shape[:-1], 3)
        return measured, torch.zeros(*a.shape[:-1], 2), 10.0 * (agreement - 0.5)


def planted(pairs: list[tuple[int, int]], steps: int = 96) -> tuple[Tensor, Tensor]:
    """Relative steps and place codes in which each pair (earlier frame, later frame) of steps shows one place."""
    generator = torch.Generator().manual_seed(7)
    relative = 0.1 * torch.randn(1, steps, 3, generator=generator)
    codes = torch.randn(1, steps, 128, generator=generator)
    for earlier, later in pairs:
        codes[0, later] = codes[0, earlier]
    return relative, codes


def search(relative: Tensor, codes: Tensor, block: int = 8, **changes: int) -> Loops:
    limits = {"per_pose": 2, "most": 6, "min_separation": 3, **changes}
    return find_loops(Identity(place_config("maze2d")), codes, poses_in_blocks(relative, block), **limits)


def test_planted_duplicates_are_found_and_measured_from_the_start_of_their_block() -> None:
    relative, codes = planted([(2, 47), (13, 71), (30, 95)])
    loops = search(relative, codes)
    found = {
        (frame, end): number
        for number, (frame, end) in enumerate(zip(loops.frame[0].tolist(), loops.end[0].tolist(), strict=True))
        if loops.similarity[0, number] > 0.99
    }
    assert set(found) == {(2, 5), (13, 8), (30, 11)}
    for (frame, _), number in found.items():
        assert loops.start[0, number] == frame // 8
        start = se2.r2g(relative)[0, frame // 8 * 8 - 1] if frame >= 8 else torch.zeros(3)
        place = se2.between(start, se2.r2g(relative)[0, frame])
        expected = se2.compose(place, torch.tensor([0.1, -0.2, 0.3]))
        assert torch.allclose(loops.measured[0, number], expected, atol=1e-5)
    assert loops.valid.all()


@pytest.mark.parametrize("separation", [1, 3, 8])
def test_separation_is_respected(separation: int) -> None:
    relative, codes = planted([(k, k + 9) for k in range(0, 80, 8)])
    loops = search(relative, codes, min_separation=separation, most=50)
    valid = loops.valid[0]
    assert valid.any()
    assert (loops.end - loops.frame // 8)[0][valid].min() >= separation
    assert (loops.start <= loops.end).all()


def test_each_pose_takes_its_candidates_from_different_blocks() -> None:
    relative, codes = planted([(0, 95), (1, 95), (2, 95), (20, 95)])
    codes[0, 1] = codes[0, 2] = codes[0, 20] = codes[0, 0] = codes[0, 95]
    loops = search(relative, codes, most=50)
    blocks = (loops.frame[0] // 8)[(loops.end[0] == 11) & loops.valid[0]].tolist()
    assert sorted(blocks) == [0, 2]


@pytest.mark.parametrize("steps", [8, 24, 40])
def test_with_fewer_candidates_than_asked_for_the_rest_is_fill(steps: int) -> None:
    relative, codes = planted([], steps)
    loops = search(relative, codes, most=96)
    blocks = steps // 8
    expected = sum(min(2, max(0, end - 3 + 1)) for end in range(blocks))
    assert loops.valid.sum().item() == expected
    for value in (loops.start, loops.end, loops.frame, loops.measured, loops.logit, loops.similarity):
        assert value.shape[1] == loops.valid.shape[1]
        assert value.isfinite().all()
    assert (loops.start <= loops.end).all() and loops.end.max() < blocks and loops.frame.max() < steps


def test_the_strongest_beliefs_are_kept() -> None:
    relative, codes = planted([(2, 47), (13, 71), (30, 95)])
    few, many = search(relative, codes, most=3), search(relative, codes, most=40)
    kept, all_logits = few.logit[0].sort(descending=True).values, many.logit[0].sort(descending=True).values
    assert torch.allclose(kept, all_logits[:3])


def test_batch_is_as_many_singles() -> None:
    relative = torch.cat([planted([(2, 47)])[0], planted([(9, 88), (30, 95)])[0]])
    codes = torch.cat([planted([(2, 47)])[1], planted([(9, 88), (30, 95)])[1]])
    together = search(relative, codes)
    for k in range(2):
        alone = search(relative[k : k + 1], codes[k : k + 1])
        assert torch.equal(together.frame[k], alone.frame[0]) and torch.equal(together.end[k], alone.end[0])
        assert torch.allclose(together.measured[k], alone.measured[0], atol=1e-6)
