"""Pose aggregation: block composition, spread corrections, variances against sampling."""

import pytest
import torch
from torch import nn

from ngo_estimator.geometry import se2
from ngo_estimator.ngo.pose_aggregation import (
    PoseAggregation,
    PoseAggregationConfig,
    block_variances,
    frame_poses,
    poses_in_blocks,
)


def steps(batch: int, count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(batch, count, 3, generator=generator, dtype=torch.float64)
    return values * torch.tensor([0.1, 0.02, 0.15]) + torch.tensor([0.2, 0.0, 0.05])


def test_layers_are_the_papers() -> None:
    layers = list(PoseAggregation(PoseAggregationConfig(motion_feature_size=5)).layers)
    convolutions = [layer for layer in layers if isinstance(layer, nn.Conv1d)]
    pools = [layer for layer in layers if isinstance(layer, nn.MaxPool1d)]
    assert {(c.kernel_size, c.stride, c.padding) for c in convolutions} == {((3,), (1,), (1,))}
    assert [(p.kernel_size, p.stride, p.padding) for p in pools] == [(2, 2, 0)] * 3


@pytest.mark.parametrize("block", [1, 4, 8])
def test_meta_poses_composed_are_the_trajectory_at_the_ends_of_blocks(block: int) -> None:
    relative = steps(3, 48)
    in_blocks = poses_in_blocks(relative, block)
    assert in_blocks.shape == (3, 48 // block, block, 3)
    assert torch.allclose(se2.r2g(in_blocks[:, :, -1]), se2.r2g(relative)[:, block - 1 :: block])


@pytest.mark.parametrize("block", [1, 4, 8])
def test_uncorrected_meta_poses_give_the_odometry_back(block: int) -> None:
    relative = steps(3, 48)
    in_blocks = poses_in_blocks(relative, block)
    assert torch.allclose(frame_poses(in_blocks, in_blocks[:, :, -1]), se2.r2g(relative))


def test_corrected_frames_meet_the_meta_poses_without_a_jump() -> None:
    relative = steps(2, 64)
    in_blocks = poses_in_blocks(relative, 8)
    meta = in_blocks[:, :, -1] + 0.08 * torch.randn(2, 8, 3, dtype=torch.float64)
    frames = frame_poses(in_blocks, meta)
    assert torch.allclose(frames[:, 7::8], se2.r2g(meta))
    # An eighth of a correction a step, turned by what the block turns at most: no step gains more than this.
    growth = (se2.g2r(frames)[..., :2] - relative[..., :2]).norm(dim=-1)
    correction = meta - in_blocks[:, :, -1]
    bound = correction[..., :2].norm(dim=-1) / 8 + correction[..., 2].abs() * relative[..., :2].norm(dim=-1).max()
    assert (growth.reshape(2, 8, 8) <= bound[..., None] + 1e-9).all()


def test_block_variances_are_those_of_sampled_blocks() -> None:
    generator = torch.Generator().manual_seed(1)
    relative = steps(1, 16)
    std = torch.tensor([0.01, 0.01, 0.02], dtype=torch.float64) * (1.0 + torch.rand(1, 16, 1, generator=generator))
    noise = torch.randn(40_000, 16, 3, generator=generator, dtype=torch.float64) * std
    sampled = poses_in_blocks(relative + noise, 8)[:, :, -1].var(dim=0)
    expected = block_variances(poses_in_blocks(relative, 8), std.log())[0]
    assert torch.allclose(expected, sampled, rtol=0.05)
