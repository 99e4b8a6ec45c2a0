"""Frames that see the same walls are found by their poses, and measured by their ranges."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import Scans
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.loops.overlaps import OVERLAP_LOGIT, find_overlaps, shared_views
from ngo_estimator.loops.pair_measurement import PairViews, fuse_views, measure_overlaps
from ngo_estimator.ngo.pose_aggregation import poses_in_blocks
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.unit.ngo_estimator.rooms import CAMERA, camera_pair_head, drive_with_a_camera, seen_by_camera
from tests.unit.ngo_estimator.samples import small_optimizer, with_origin
from training.scoring.online_estimate import steps_of

SEARCH = LoopSearch(2, 8, 3, 0, 1, registrations=5, overlaps=20)


def view(x: float, y: float, yaw_deg: float) -> Tensor:
    return torch.tensor([[x, y, math.radians(yaw_deg)]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("a", "b", "least", "most"),
    [
        pytest.param(view(1.0, 1.0, 10.0), view(1.0, 1.0, 10.0), 0.95, 1.0, id="the same"),
        pytest.param(view(0.6, 1.2, 0.0), view(5.2, 1.2, 180.0), 0.25, 0.8, id="face to face"),
        pytest.param(view(2.0, 1.2, 180.0), view(3.0, 1.2, 0.0), 0.0, 0.1, id="back to back"),
        pytest.param(view(1.5, 1.2, 0.0), view(1.5, 1.2, 90.0), 0.0, 0.2, id="another side"),
    ],
)
def test_frames_share_what_both_see(a: Tensor, b: Tensor, least: float, most: float) -> None:
    relative = se2.between(a, b).float()
    shared = shared_views(CAMERA, seen_by_camera(a), seen_by_camera(b), relative)
    assert least <= shared.item() <= most
    torch.testing.assert_close(
        shared, shared_views(CAMERA, seen_by_camera(b), seen_by_camera(a), se2.inverse(relative))
    )


def test_under_a_wrong_pose_less_is_shared_and_without_ranges_nothing() -> None:
    a, b = view(0.6, 1.2, 0.0), view(5.2, 1.2, 180.0)
    right = se2.between(a, b).float()
    wrong = right + torch.tensor([[0.0, 0.0, math.radians(40.0)]])
    shared, less = (
        shared_views(CAMERA, seen_by_camera(a), seen_by_camera(b), relative).item() for relative in (right, wrong)
    )
    assert less < 0.5 * shared
    assert shared_views(CAMERA, seen_by_camera(a), torch.zeros(1, CAMERA.rays), right).item() == 0.0


def test_frames_that_face_each_other_are_measured_by_the_walls_between_them() -> None:
    a, b = view(0.6, 1.2, 5.0), view(5.2, 1.3, 176.0)
    near_a, near_b = (se2.compose(pose, torch.tensor([[0.2, 0.0, 0.05]], dtype=torch.float64)) for pose in (a, b))
    truth = se2.between(a, b)
    start = (truth + torch.tensor([[0.2, -0.2, math.radians(3.0)]])).float()
    ranges = [torch.stack([seen_by_camera(x), seen_by_camera(y)]) for x, y in ((a, near_a), (b, near_b))]
    from_a = torch.stack([se2.between(a, x) for x in (a, near_a)]).float()
    to_b = torch.stack([se2.between(x, b) for x in (b, near_b)]).float()
    (measured, log_scale, spread), found = measure_overlaps(CAMERA, PairViews(*ranges, from_a, to_b), start, 6)
    assert found.all()
    # Where along the corridor they are, its walls do not say.
    along, across, turned = (measured - truth)[0].abs().tolist()
    assert along < 0.3 and across < 0.03 and turned < math.radians(0.3)
    assert log_scale[0, 0].exp() > 0.2 and log_scale[0, 1].exp() < math.radians(1.0) and (spread.exp() < 0.05).all()
    # Of frames that cannot be registered nothing is found.
    nothing = [torch.zeros_like(x) for x in ranges]
    _, found = measure_overlaps(CAMERA, PairViews(*nothing, from_a, to_b), start, 6)
    assert not found.any()


def test_overlaps_are_found_under_poses_and_measured_nearer_the_truth() -> None:
    *_, codes, truth = drive_with_a_camera(160)
    in_blocks = poses_in_blocks(se2.g2r(truth).float(), 8)
    true_nodes = with_origin(truth[:, 7::8])
    drift = torch.tensor([0.1, 0.1, math.radians(2.0)]) * torch.randn(
        1, 21, 3, generator=torch.Generator().manual_seed(2)
    )
    nodes = true_nodes + drift
    loops = find_overlaps(Scans(codes[..., 12:], CAMERA), in_blocks, nodes, torch.ones(1, 20, 4), SEARCH)
    assert loops.start.shape == (1, SEARCH.overlaps) and loops.valid.sum() > 8
    found = loops.valid[0]
    start, end = loops.start[0][found], loops.end[0][found] + 1
    assert (end - start >= SEARCH.min_separation).all() and (start >= 1).all()
    assert torch.bincount(end).max() <= SEARCH.per_pose
    assert (loops.frame[0][found] == 8 * start - 1).all()
    assert (loops.logit == OVERLAP_LOGIT).all() and (loops.similarity == 4.0).all()

    def errors(relative_poses: Tensor) -> Tensor:
        return se2.wrapped(relative_poses.double() - se2.between(true_nodes[0, start], true_nodes[0, end])).abs()

    before, after = errors(se2.between(nodes[0, start], nodes[0, end])), errors(loops.measured[0][found])
    assert (after.median(0).values < 0.2 * before.median(0).values).all()
    # What is not found is a loop like any other, of no weight.
    assert (loops.start <= loops.end).all() and loops.measured.isfinite().all() and loops.log_scale.isfinite().all()


def test_each_trajectory_of_a_batch_has_its_own() -> None:
    both = [torch.cat(parts) for parts in zip(*(drive_with_a_camera(160, seed) for seed in (0, 1)), strict=True)]
    both[2][1, 40:] = 0.0  # what it sees is lost
    nodes = with_origin(both[3][:, 7::8])

    def found(which: slice) -> tuple[Tensor, Tensor, Tensor]:
        relative, _, codes, _ = (part[which] for part in both)
        scans = Scans(codes[..., 12:], CAMERA)
        embeddings = torch.ones(len(relative), 20, 4)
        loops = find_overlaps(scans, poses_in_blocks(relative, 8), nodes[which], embeddings, SEARCH)
        return loops.valid, loops.end, loops.measured

    together = found(slice(0, 2))
    assert together[0][0].sum() > 8 > together[0][1].sum()
    for k in (0, 1):
        for one, many in zip(found(slice(k, k + 1)), together, strict=True):
            torch.testing.assert_close(one[0], many[k], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("iterations", [2, 5])
def test_an_optimizer_of_more_than_two_iterations_takes_them(iterations: int) -> None:
    relative, log_std, codes, truth = drive_with_a_camera(160)
    motion = torch.zeros(1, 160, 6)
    errors = {}
    for overlaps in (0, 20):
        search = dataclasses.replace(SEARCH, overlaps=overlaps)
        optimizer = small_optimizer("gauss_newton", iterations=iterations, search=search)
        loops = optimizer.find_loops(relative, codes, camera_pair_head())
        # Places are not recognised at all.
        loops = dataclasses.replace(loops, valid=torch.zeros_like(loops.valid))
        result = optimizer(relative, log_std, motion, loops)
        assert result.loops is not None and result.loop_weights is not None
        taken = overlaps if iterations > 2 else 0
        assert result.loops.start.shape[1] == result.loop_weights.shape[1] == loops.start.shape[1] + taken
        errors[overlaps] = (result.poses - truth)[..., :2].norm(dim=-1).square().mean().sqrt().item()
    assert errors[20] < 0.3 * errors[0] if iterations > 2 else errors[20] == errors[0]


def test_without_registrations_there_are_no_overlaps() -> None:
    optimizer = small_optimizer(search=SEARCH)
    assert optimizer.with_registrations(3).config.search.overlaps == SEARCH.overlaps
    assert optimizer.with_registrations(0).config.search.overlaps == 0
    for wrong in ({"overlaps": -1}, {"overlaps": 5, "registrations": 0}):
        with pytest.raises(ValueError, match=r"overlaps is .*; expected"):
            dataclasses.replace(SEARCH, **wrong)


def online(overlaps: int, window: int, steps: int = 320, first: int = 0) -> float:
    """Position RMSE (m) in the end of what is corrected online from step ``first`` on, where no place is recognised."""
    relative, log_std, codes, truth = drive_with_a_camera(steps)
    features = {"relative": relative[0].numpy(), "log_std": log_std[0].numpy(), "codes": codes[0].numpy()}
    features["motion"] = np.zeros((steps, 6))
    search = dataclasses.replace(SEARCH, most=1, per_pose=2, overlaps=overlaps)
    core = OnlineTrajectory(
        small_optimizer("gauss_newton", iterations=5, search=search), camera_pair_head(), window, key_frames=12
    )
    for k, step in enumerate(steps_of(features)):
        core.update(step, optimize=k >= first)
    trajectory = core.trajectory()
    assert trajectory is not None
    errors = trajectory.poses_xyyaw[1:, :2] - truth[0, :, :2].numpy()
    return float(np.sqrt(np.square(errors).sum(1).mean()))


@pytest.mark.parametrize("window", [640, 160, 96])
def test_online_the_newest_frame_is_registered_to_those_it_shares_walls_with(window: int) -> None:
    without, with_overlaps = online(0, window), online(40, window)
    assert with_overlaps < 0.3 * without


def test_in_a_pause_none_are_looked_for() -> None:
    # Poses that nothing has corrected say nothing; of the last step alone, all are corrected at once.
    errors = [online(overlaps, 640, 160, first=159) for overlaps in (0, 40)]
    assert errors[0] == errors[1]
    assert online(40, 640, 160) < 0.7 * errors[0]


def test_views_are_fused_to_the_same_where_nobody_asks_for_a_gradient() -> None:
    generator = torch.Generator().manual_seed(20000)
    measured = torch.randn(5, 2, 3, 3, generator=generator)
    measured[..., 2] += math.pi
    log_scale = torch.randn(5, 2, 3, 2, generator=generator)
    expected = fuse_views(measured.clone().requires_grad_(), log_scale)
    for fused, same in zip(fuse_views(measured, log_scale), expected, strict=True):
        assert fused.shape == same.shape and fused.dtype == same.dtype
        torch.testing.assert_close(fused, same.detach(), atol=1e-5, rtol=1e-5)
