"""Loop closures against plain loops over what they find, compare and spread."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops, LoopSearch, find_loops
from ngo_estimator.networks.place_encoder import PairHead, PlaceConfig
from ngo_estimator.ngo.loop_closing import spread_over_span
from ngo_estimator.ngo.loop_gates import loop_residuals, odometry_variances
from ngo_estimator.ngo.pose_aggregation import poses_in_blocks
from tests.unit.ngo_estimator.samples import make_loops, meta_steps, place_config, with_origin

DOUBLE = torch.float64


def test_residual_is_measured_less_current_along_the_map() -> None:
    relative = meta_steps(6)
    poses = with_origin(se2.r2g(relative))
    exact = se2.between(poses[:, 1], poses[:, 5])
    nodes = torch.tensor([[[1, 5]]])
    assert loop_residuals(nodes, exact[:, None], poses).abs().max() < 1e-12
    # The measurement says: 0.2 m further in the direction in which the start looks, and 0.1 rad more to the left.
    more = exact + torch.tensor([0.2, 0.0, 0.1], dtype=DOUBLE)
    x, y, yaw = loop_residuals(nodes, more[:, None], poses)[0, 0]
    heading = poses[0, 1, 2]
    assert torch.allclose(
        torch.stack((x, y, yaw)), torch.stack((0.2 * heading.cos(), 0.2 * heading.sin(), yaw * 0 + 0.1))
    )


def test_heading_residual_is_wrapped() -> None:
    poses = torch.zeros(1, 3, 3, dtype=DOUBLE)
    poses[0, 2, 2] = 6.0
    measured = torch.tensor([[[0.0, 0.0, -0.1]]], dtype=DOUBLE)
    assert loop_residuals(torch.tensor([[[0, 2]]]), measured, poses)[0, 0, 2].item() == pytest.approx(
        2 * torch.pi - 6.1
    )


def test_spread_is_the_weighted_mean_over_the_loops_on_each_step() -> None:
    loops = make_loops([0, 2, 3, 7], [5, 4, 9, 7])
    values, weights = torch.randn(1, 4, 3, dtype=DOUBLE), torch.tensor([[0.7, 0.2, 1.0, 0.5]], dtype=DOUBLE)
    spread, support = spread_over_span(loops.nodes, values, weights, 11)
    for step in range(11):
        total, sum_weights = torch.zeros(3, dtype=DOUBLE), 0.0
        for number, (start, end) in enumerate(zip(loops.start[0].tolist(), loops.end[0].tolist(), strict=True)):
            if start <= step <= end:
                total += weights[0, number] * values[0, number] / (end - start + 1)
                sum_weights += weights[0, number].item()
        assert torch.allclose(spread[0, step], total / (sum_weights + 1e-3), atol=1e-12)
        assert support[0, step].item() == pytest.approx(sum_weights, abs=1e-12)


def test_arrays_of_one_trajectory_give_what_tensors_of_a_batch_give() -> None:
    poses, loops = with_origin(se2.r2g(meta_steps(9))), make_loops([0, 2, 1, 4], [8, 6, 8, 4])
    generator = torch.Generator().manual_seed(1)
    measured, variance, weights = (
        torch.rand(1, *shape, generator=generator, dtype=DOUBLE) for shape in ((4, 3), (9, 3), (4,))
    )
    arrays = [x[0].numpy() for x in (loops.nodes, measured, poses, variance, weights)]
    nodes, of_measured, of_poses, of_variance, of_weights = arrays
    residuals = loop_residuals(loops.nodes, measured, poses)
    pairs = [
        (residuals, loop_residuals(nodes, of_measured, of_poses)),
        (odometry_variances(loops.nodes, poses, variance), odometry_variances(nodes, of_poses, of_variance)),
        *zip(
            spread_over_span(loops.nodes, residuals, weights, 9),
            spread_over_span(nodes, residuals[0].numpy(), of_weights, 9),
            strict=True,
        ),
    ]
    for tensors, of_one in pairs:
        np.testing.assert_allclose(of_one, tensors[0].numpy(), rtol=1e-10, atol=1e-12)


def test_loops_of_weight_zero_spread_nothing() -> None:
    spread, support = spread_over_span(
        make_loops([0, 1], [4, 3]).nodes, torch.randn(1, 2, 3, dtype=DOUBLE), torch.zeros(1, 2, dtype=DOUBLE), 6
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


def search(relative: Tensor, codes: Tensor, block: int = 8, **changes: float) -> Loops:
    limits = LoopSearch(**{"per_pose": 2, "most": 6, "min_separation": 3, "min_apart": 0, "views": 1, **changes})
    return find_loops(Identity(place_config("maze2d")), codes, poses_in_blocks(relative, block), limits)


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


@pytest.mark.parametrize(("apart", "expected"), [(0, [0, 1]), (1, [0, 3]), (3, [0, 5])])
def test_candidates_of_a_pose_keep_their_distance(apart: int, expected: list[int]) -> None:
    relative, codes = planted([])
    # The last pose looks most like a frame in block 0, then 1, 3 and 5.
    for block, share in ((0, 1.0), (1, 0.9), (3, 0.8), (5, 0.7)):
        codes[0, 8 * block] = share * codes[0, 95] + (1.0 - share) * codes[0, 8 * block]
    loops = search(relative, codes, min_apart=apart, most=50)
    blocks = (loops.frame[0] // 8)[(loops.end[0] == 11) & loops.valid[0]]
    assert sorted(blocks.tolist()) == expected


def test_measurements_have_gradients_and_the_choice_has_none() -> None:
    relative, codes = planted([(2, 47), (13, 71)])
    codes.requires_grad_()
    pair_head = PairHead(place_config("maze2d"))
    loops = find_loops(pair_head, codes, poses_in_blocks(relative, 8), LoopSearch(per_pose=2, most=6, min_separation=3))
    (loops.measured.sum() + loops.logit.sum() + loops.log_scale.sum()).backward()
    assert codes.grad is not None and codes.grad.abs().sum(-1).count_nonzero() >= 6
    assert not loops.similarity.requires_grad and loops.embeddings.requires_grad


class Surveyor(PairHead):
    """Its codes begin with the true pose of their frame; it measures exactly but for an error of each pair's own."""

    def __init__(self, config: PlaceConfig, sigma: float) -> None:
        super().__init__(config)
        self.embedding = nn.Identity()  # type: ignore[assignment]
        self.sigma = sigma

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        error = self.sigma * torch.sin(1e4 * (a[..., :3] + 1.7 * b[..., :3]))
        scale = torch.full((*a.shape[:-1], 2), math.log(self.sigma + 1e-6))
        return se2.between(a[..., :3], b[..., :3]) + error, scale, torch.ones(a.shape[:-1])


def surveyed(sigma: float, views: int) -> tuple[Loops, Tensor]:
    """Loops of a robot on a circle whose odometry is exact, and the true poses between their ends."""
    relative = torch.tensor([0.1, 0.0, 2.0 * torch.pi / 96]).expand(1, 192, 3)
    poses = se2.r2g(relative)
    codes = torch.cat((poses[..., :2], poses[..., 2:], torch.zeros(1, 192, 125)), dim=-1)
    search = LoopSearch(per_pose=2, most=40, min_separation=6, views=views)
    loops = find_loops(Surveyor(place_config("maze2d"), sigma), codes, poses_in_blocks(relative, 8), search)
    ends = with_origin(poses[:, 7::8])[0]
    return loops, se2.between(ends[loops.start[0]], ends[loops.end[0] + 1])


@pytest.mark.parametrize("views", [1, 2, 5, 9])
def test_exact_views_agree(views: int) -> None:
    loops, truth = surveyed(0.0, views)
    error = (loops.measured[0] - truth)[loops.valid[0]]
    assert error[:, :2].abs().max() < 1e-4 and se2.wrap(error[:, 2]).abs().max() < 1e-4
    assert loops.spread.max() < -6.0


def test_more_views_measure_better_and_tell_how_far_they_disagree() -> None:
    errors = {}
    for views in (1, 5, 9):
        loops, truth = surveyed(0.02, views)
        error = (loops.measured[0] - truth)[loops.valid[0]]
        errors[views] = se2.wrap(error[:, 2]).square().mean().sqrt().item()
        assert loops.log_scale.exp().mean().item() == pytest.approx(0.02 / math.sqrt(views), rel=0.3)
        if views > 1:
            assert 0.005 < loops.spread.exp().mean().item() < 0.03
    assert errors[9] < errors[5] < errors[1]
    assert errors[9] < 0.6 * errors[1]


def test_with_a_drift_the_most_similar_that_the_odometry_allows_are_taken() -> None:
    relative, codes = planted([])
    relative[..., :] = torch.tensor([0.1, 0.0, 0.0])  # straight on: after 96 steps it is 9.6 m away
    for frame, share in ((8, 1.0), (40, 0.9), (64, 0.8)):
        codes[0, frame] = share * codes[0, 95] + (1.0 - share) * codes[0, frame]
    blocks = {}
    # One metre and the drift in so many steps, which are 8.7, 5.5 and 3.1 m.
    for drift_m in (0.0, 0.7, 0.5, 0.3):
        loops = search(relative, codes, per_pose=1, most=50, drift_m=drift_m, drift_rad=drift_m)
        chosen = (loops.end[0] == 11) & loops.valid[0] & (loops.similarity[0] > 0.5)
        blocks[drift_m] = (loops.frame[0] // 8)[chosen].tolist()
    assert blocks == {0.0: [1], 0.7: [5], 0.5: [8], 0.3: []}
    turned = relative.clone()
    turned[0, 80, 2] = 1.5
    assert not (search(turned, codes, per_pose=1, most=50, drift_m=0.5, drift_rad=0.1).similarity[0] > 0.5).any()


@pytest.mark.parametrize("drift", [(0.1, 0.0), (0.0, 0.1), (-0.1, -0.1)])
def test_a_drift_is_of_positions_and_headings(drift: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="expected two positive numbers, or 0 and 0"):
        LoopSearch(drift_m=drift[0], drift_rad=drift[1])


@pytest.mark.parametrize(
    "change",
    [{"per_pose": 0}, {"most": 0}, {"min_separation": 0}, {"min_apart": -1}, {"views": 0}, {"views": 99}],
)
def test_impossible_searches_are_refused(change: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=rf"{next(iter(change))} is .*; expected (at least [01]|1 to 9)"):
        LoopSearch(**change)


def test_odometry_variances_are_the_diagonal_of_the_propagated_covariance() -> None:
    relative = meta_steps(9)
    loops = make_loops([0, 2, 1, 4], [8, 6, 8, 4])
    variance = 0.1 * torch.rand(1, 9, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)

    def ends(steps: Tensor) -> Tensor:
        return with_origin(se2.r2g(steps[None]))[0, loops.end[0] + 1]

    jacobian = torch.autograd.functional.jacobian(ends, relative[0])
    index = torch.arange(9)
    on_loop = (index >= loops.start[0, :, None]) & (index <= loops.end[0, :, None])
    expected = ((jacobian * on_loop[:, None, :, None]).square() * variance[0]).sum((-2, -1))
    result = odometry_variances(loops.nodes, with_origin(se2.r2g(relative)), variance)[0]
    assert torch.allclose(result, expected, atol=1e-12)


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
