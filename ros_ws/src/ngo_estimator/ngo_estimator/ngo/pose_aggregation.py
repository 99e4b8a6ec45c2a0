"""Pose aggregation: many frames to few meta-poses (paper, section "Pose Aggregation")."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ngo_estimator.data.configuration import check
from ngo_estimator.geometry import se2

_LARGEST_INPUT = 10.0
"""Steps of more ``relative_std``, as where frames were lost or nobody saw the motion, look as if they had so many."""


@dataclass(frozen=True)
class PoseAggregationConfig:
    """What the aggregation is made of.

    ``halvings`` max-poolings make one meta-pose of ``2 ** halvings`` steps. ``relative_std`` (m, m, rad), the deviation
    of one step, normalises the relative poses.
    """

    motion_feature_size: int
    halvings: int = 3
    width: int = 64
    relative_std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        check(self, "halvings", "0 to 6", lambda x: 0 <= x <= 6)
        check(self, "motion_feature_size width", "at least 1", lambda x: x >= 1)

    @property
    def block(self) -> int:
        """Steps in a meta-pose."""
        return 2**self.halvings

    @property
    def reach(self) -> int:
        """Steps before and after a block that its meta-feature depends on."""
        return 2 * self.block - 1


class PoseAggregation(nn.Module):
    """Temporal convolutions (k3 s1 p1) and max-poolings (k2 s2) in turn, over motion features and relative poses."""

    def __init__(self, config: PoseAggregationConfig) -> None:
        super().__init__()
        self.config = config
        channels = config.motion_feature_size + 6
        layers: list[nn.Module] = []
        for _ in range(config.halvings):
            layers += [nn.Conv1d(channels, config.width, 3, 1, 1), nn.ReLU(), nn.MaxPool1d(2, 2)]
            channels = config.width
        layers += [nn.Conv1d(channels, config.width, 3, 1, 1), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.register_buffer("relative_std", torch.tensor(config.relative_std), persistent=False)
        self.relative_std: Tensor

    def forward(self, relative: Tensor, log_std: Tensor, motion_features: Tensor) -> Tensor:
        """Aggregate ``(batch, steps, ...)`` inputs into meta-features ``(batch, steps / block, width)``.

        Args:
            relative: relative poses ``(batch, steps, 3)``; ``steps`` is a multiple of the block.
            log_std: logarithm of their standard deviations ``(batch, steps, 3)``.
            motion_features: ``(batch, steps, motion_feature_size)``.
        """
        scaled = (relative / self.relative_std).clamp(-_LARGEST_INPUT, _LARGEST_INPUT)
        certainty = (log_std - self.relative_std.log()).clamp(-_LARGEST_INPUT, _LARGEST_INPUT)
        return self.layers(torch.cat((motion_features, scaled, certainty), dim=-1).mT).mT


def poses_in_blocks(relative: Tensor, block: int) -> Tensor:
    """Poses ``(batch, blocks, block, 3)`` after each step, in the frame of the start of their block.

    The last of a block is the relative meta-pose: the composition of the block's steps.
    """
    batch, steps, _ = relative.shape
    if steps % block:
        raise ValueError(f"{steps} steps do not divide into blocks of {block}")
    return se2.r2g(relative.reshape(batch, steps // block, block, 3))


def block_variances(in_blocks: Tensor, log_std: Tensor) -> Tensor:
    """Variances ``(batch, blocks, 3)`` of the relative meta-poses, in the frame of the start of their block.

    The steps' errors are taken as independent and isotropic in position (the mean of the two variances), heading errors
    act on what lies behind them by their lever arm. Cross-correlations are dropped.
    """
    batch, blocks, block, _ = in_blocks.shape
    variance = torch.exp(2.0 * log_std).reshape(batch, blocks, block, 3)
    lever = in_blocks[..., -1:, :2] - in_blocks[..., :2]
    position = variance[..., :2].mean(-1)
    heading = variance[..., 2]
    x = position + heading * lever[..., 1].square()
    y = position + heading * lever[..., 0].square()
    return torch.stack((x, y, heading), dim=-1).sum(-2)


def in_block_poses(in_blocks: Tensor, meta_relative: Tensor) -> Tensor:
    """Poses within blocks ``(batch, blocks, block, 3)`` under corrected relative meta-poses.

    A block's correction is spread evenly over its steps, so that the trajectory stays continuous.

    Args:
        in_blocks: uncorrected poses within blocks ``(batch, blocks, block, 3)``.
        meta_relative: corrected relative meta-poses ``(batch, blocks, 3)``.
    """
    block = in_blocks.shape[2]
    correction = se2.wrapped(meta_relative - in_blocks[..., -1, :])
    share = torch.arange(1, block + 1, dtype=in_blocks.dtype, device=in_blocks.device) / block
    return in_blocks + share[..., None] * correction.unsqueeze(-2)


def frame_poses(in_blocks: Tensor, meta_relative: Tensor) -> Tensor:
    """Global poses ``(batch, blocks * block, 3)`` of all frames; arguments as of ``in_block_poses``."""
    corrected = in_block_poses(in_blocks, meta_relative)
    ends = se2.r2g(meta_relative)
    starts = torch.cat((torch.zeros_like(ends[:, :1]), ends[:, :-1]), dim=1)
    xy = starts[..., None, :2] + se2.rotate(starts[..., None, 2], corrected[..., :2])
    yaw = starts[..., None, 2:] + corrected[..., 2:]
    return torch.cat((xy, yaw), dim=-1).flatten(1, 2)
