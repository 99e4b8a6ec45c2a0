"""Odometry measured again: every frame of a block is registered to the frame where the block begins.

The paper's meta-poses are as good as the local odometry. With this, errors of single steps no longer add up within a
block, and what is left of them is known.
"""

import math

import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.networks.place_encoder import PairHead

_NOISE = 2.0
"""Deviations of the odometry over a few steps, in units of what the steps' own deviations make them."""


def registered_steps(
    pair_head: PairHead,
    relative: Tensor,
    log_std: Tensor,
    codes: Tensor,
    block: int,
    registrations: int,
    origin_code: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The steps of trajectories, measured again.

    Args:
        relative: steps ``(batch, steps, 3)`` of the odometry (m, m, rad), a whole number of blocks; log_std: logarithm
            of their deviations.
        codes: place codes ``(batch, steps, code_length)`` of the frame after each step.
        registrations: steps of each registration; with 0, or ranges that are not good enough for it, everything stays
            as it is.
        origin_code: that of the first frame ``(batch, code_length)``; without it the first step stays as it is.

    Returns:
        Steps and logarithms of deviations in the shape of the ones given. The deviations are such that a block has
        those of its registration.
    """
    registration = pair_head.config.registration
    if registrations == 0 or (registration is not None and not registration.odometry):
        return relative, log_std
    steps, deviations, ends = (x.unflatten(1, (-1, block)) for x in (relative, log_std, codes))
    before = ends[:, :-1, -1]
    if origin_code is not None:
        starts = torch.cat((origin_code.unsqueeze(1), before), dim=1)
        both = _registered_blocks(pair_head, steps, deviations, starts, ends, registrations)
        return both[0].flatten(1, 2), both[1].flatten(1, 2)
    first = _unanchored_block(pair_head, steps[:, 0], deviations[:, 0], ends[:, 0], registrations)
    others = _registered_blocks(pair_head, steps[:, 1:], deviations[:, 1:], before, ends[:, 1:], registrations)
    new = [torch.cat((one.unsqueeze(1), more), dim=1).flatten(1, 2) for one, more in zip(first, others, strict=True)]
    return new[0], new[1]


def _unanchored_block(
    pair_head: PairHead, relative: Tensor, log_std: Tensor, codes: Tensor, registrations: int
) -> tuple[Tensor, Tensor]:
    """As ``_registered_blocks`` for blocks whose start has no code: registered to the frame after their first step."""
    rest = _registered_blocks(
        pair_head, relative[..., 1:, :], log_std[..., 1:, :], codes[..., 0, :], codes[..., 1:, :], registrations
    )
    return torch.cat((relative[..., :1, :], rest[0]), dim=-2), torch.cat((log_std[..., :1, :], rest[1]), dim=-2)


def _registered_blocks(
    pair_head: PairHead, relative: Tensor, log_std: Tensor, start_codes: Tensor, codes: Tensor, registrations: int
) -> tuple[Tensor, Tensor]:
    """The steps of blocks ``(..., block, 3)``, measured again.

    Args:
        relative: steps ``(..., block, 3)``; log_std: logarithm of their deviations ``(..., block, 3)``.
        start_codes: place code of the frame before each block ``(..., code_length)``; codes: of the frame after each
            step ``(..., block, code_length)``.
    """
    poses = se2.r2g(relative)
    variance = torch.exp(2.0 * log_std).cumsum(-2)
    position = variance[..., :2].mean(-1) + variance[..., 2] * poses[..., :2].square().sum(-1)
    prior = 0.5 * torch.stack((position, variance[..., 2]), dim=-1).log() + math.log(_NOISE)
    poses, after = pair_head.register(start_codes.unsqueeze(-2), codes, poses, prior, registrations)
    share = 0.5 * math.log(relative.shape[-2])
    return se2.g2r(poses), after[..., [0, 0, 1]] - share
