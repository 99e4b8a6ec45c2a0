"""Loops found by place codes are those of our own optimizer; true ones lie where the truth says."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch, find_loops
from ngo_estimator.loops.overlaps import find_overlaps
from ngo_estimator.ngo.pose_aggregation import poses_in_blocks
from tests.unit.ngo_estimator.rooms import camera_pair_head, drive_with_a_camera
from tests.unit.ngo_estimator.samples import small_pair_head, with_origin
from training.baselines.loop_factors import (
    Seen,
    found_loops,
    measured_revisits,
    overlaps_of,
    true_revisits,
)

SEARCH = LoopSearch(per_pose=3, most=1000, min_separation=6, min_apart=1)


def circles(steps: int = 800) -> np.ndarray:
    """Truth ``(steps, 3)``: 200 steps a round of 1 m radius, each round 5 cm farther out than the one before."""
    turn = 2.0 * np.pi * np.arange(1, steps + 1) / 200.0
    radius = 1.0 + 0.05 * turn / (2.0 * np.pi)
    return np.column_stack((radius * np.cos(turn), radius * np.sin(turn), turn + np.pi / 2.0))


def drives(trajectories: int, steps: int = 160) -> Seen:
    rng = np.random.default_rng(0)
    relative = rng.normal(0.0, 0.1, (trajectories, steps, 3)).astype(np.float32)
    codes = rng.normal(0.0, 1.0, (trajectories, steps, 12)).astype(np.float16)
    return Seen(relative, np.full_like(relative, -4.0), codes, codes[:, :1])


def test_found_loops_are_those_of_the_optimizer_whatever_goes_with_them() -> None:
    seen = drives(11)
    found = found_loops(small_pair_head(), seen, SEARCH)
    assert len(found) == 11
    for number in (0, 7, 8, 10):
        inputs = (torch.from_numpy(array[number : number + 1]).float() for array in (seen.codes, seen.relative))
        loops = find_loops(small_pair_head(), next(inputs), poses_in_blocks(next(inputs), 8), SEARCH)
        valid = loops.valid[0]
        assert 0 < valid.sum() < len(valid)
        for name, value in vars(found[number]).items():
            np.testing.assert_allclose(value, getattr(loops, name)[0][valid].detach(), atol=1e-5, err_msg=name)


def test_true_revisits_are_near_and_separated_and_as_many_as_are_looked_for() -> None:
    truth = circles()
    frames, ends = true_revisits(truth, SEARCH)
    distance = np.linalg.norm(truth[frames, :2] - truth[8 * ends + 7, :2], axis=1)
    assert distance.max() <= 0.5
    assert (ends - frames // 8).min() >= SEARCH.min_separation
    # From the third round on there are places enough that are not next to each other.
    for end in range(55, 100):
        blocks = np.sort(frames[ends == end] // 8)
        assert len(blocks) == SEARCH.per_pose and np.diff(blocks).min() > SEARCH.min_apart
    assert not (ends < 6).any()
    best = {end: distance[ends == end].min() for end in range(30, 100)}
    assert max(best.values()) < 0.06


def test_measured_revisits_are_true_places_with_what_the_pair_head_says() -> None:
    seen = drives(1, 800)
    truth, search = circles(), replace(SEARCH, views=1)
    loops = measured_revisits(small_pair_head(), seen, truth, search)
    frames, ends = true_revisits(truth, search)
    np.testing.assert_array_equal(loops.start, frames // 8)
    np.testing.assert_array_equal(loops.end, ends)
    assert (loops.logit == np.inf).all()
    codes = torch.from_numpy(seen.codes[0]).float()
    with torch.no_grad():
        measured, log_scale, _ = small_pair_head()(codes[frames[5]], codes[8 * ends[5] + 7])
    steps = torch.from_numpy(seen.relative[0])[frames[5] // 8 * 8 : frames[5] + 1]
    np.testing.assert_allclose(loops.measured[5], se2.compose(se2.r2g(steps)[-1], measured), atol=1e-5)
    np.testing.assert_allclose(loops.log_scale[5], log_scale, atol=1e-5)


def test_overlaps_are_those_of_the_optimizer_under_the_graphs_poses() -> None:
    parts = [drive_with_a_camera(160, seed) for seed in (0, 1)]
    relative, _, codes, truth = (torch.cat(columns) for columns in zip(*parts, strict=True))
    search, head = LoopSearch(2, 8, 3, 0, 1, registrations=5, overlaps=20), camera_pair_head()
    nodes = with_origin(truth[:, 7::8])
    scans = head.scans(codes)
    assert scans is not None
    expected = find_overlaps(scans, poses_in_blocks(relative, 8), nodes, head.embed(codes[:, 7::8]), search)
    more = overlaps_of(head, codes.numpy(), relative.numpy(), search)
    assert len(more) == 2
    for k in (1, 0):
        found = more[k](nodes[k].numpy())
        valid = expected.valid[k]
        assert len(found.start) == valid.sum() > 8
        for name, value in vars(found).items():
            np.testing.assert_allclose(value, getattr(expected, name)[k][valid], atol=1e-4, err_msg=name)
    with pytest.raises(ValueError, match="the place codes hold no ranges; expected a registration"):
        overlaps_of(small_pair_head(), codes.numpy(), relative.numpy(), search)
