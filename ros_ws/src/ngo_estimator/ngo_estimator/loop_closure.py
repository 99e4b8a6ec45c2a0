"""Loop closures: candidates from place codes, their residuals, and the correction that they ask for.

Not in the paper, whose attention has to learn all this. A loop says where a meta-pose lies relative to an earlier
frame.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ngo_estimator import se2
from ngo_estimator.place_encoder import PairHead


@dataclass(frozen=True)
class Loops:
    """Loop candidates of a batch, ``(batch, loops)`` each.

    ``start`` indexes the global meta-poses with the origin in front: the measurement starts at the pose before
    meta-step ``start`` and ends at the pose after meta-step ``end``, so the meta-steps ``start .. end`` lie on the
    loop. ``measured`` ``(batch, loops, 3)`` is the end's pose in the frame of the start, ``log_scale`` ``(batch,
    loops, 2)`` the logarithm of its scale (position in m, heading in rad), ``logit`` the belief that it is the same
    place, ``similarity`` the inner product of the embeddings, ``frame`` the earlier frame itself, and ``valid`` false
    for fill.
    """

    start: Tensor
    end: Tensor
    frame: Tensor
    measured: Tensor
    log_scale: Tensor
    logit: Tensor
    similarity: Tensor
    valid: Tensor


@torch.no_grad()
def find_loops(
    pair_head: PairHead, codes: Tensor, in_blocks: Tensor, per_pose: int, most: int, min_separation: int
) -> Loops:
    """For each meta-pose the most similar earlier frames, measured by the pair head.

    Args:
        codes: place codes ``(batch, steps, code_size)`` of the frame after each step.
        in_blocks: poses within blocks ``(batch, blocks, block, 3)``.
        per_pose: candidates for each meta-pose, each from another block.
        most: candidates kept for the trajectory, those with the highest belief.
        min_separation: meta-steps that lie at least between a meta-pose and its candidate.
    """
    batch, blocks, block, _ = in_blocks.shape
    embeddings = pair_head.embed(codes)
    ends = embeddings[:, block - 1 :: block]
    similarity = (ends @ embeddings.mT).reshape(batch, blocks, blocks, block)
    best, best_step = similarity.max(dim=-1)
    index = torch.arange(blocks, device=codes.device)
    allowed = index[:, None] - index[None, :] >= min_separation
    best = best.masked_fill(~allowed, -2.0)
    per_pose = min(per_pose, blocks)
    top, top_block = best.topk(per_pose, dim=-1)
    top_step = best_step.gather(-1, top_block)

    flat_similarity = top.reshape(batch, -1)
    start = top_block.reshape(batch, -1)
    frame = start * block + top_step.reshape(batch, -1)
    end = index[None, :, None].expand(batch, blocks, per_pose).reshape(batch, -1)
    # The pair head is the costly part: it sees only what is most similar, twice as many as can be kept.
    keep = flat_similarity.topk(min(2 * most, flat_similarity.shape[1]), dim=-1).indices
    similarity_kept, start, frame, end = (value.gather(1, keep) for value in (flat_similarity, start, frame, end))
    earlier = codes.gather(1, frame.unsqueeze(-1).expand(-1, -1, codes.shape[-1]))
    later = codes[:, block - 1 :: block].gather(1, end.unsqueeze(-1).expand(-1, -1, codes.shape[-1]))
    measured, log_scale, logit = pair_head(earlier, later)
    logit = logit.masked_fill(similarity_kept < -1.5, -1e4)
    keep = logit.topk(min(most, logit.shape[1]), dim=-1).indices
    keep = keep.sort(dim=-1).values
    start, frame, end, logit, similarity_kept = (v.gather(1, keep) for v in (start, frame, end, logit, similarity_kept))
    measured = measured.gather(1, keep.unsqueeze(-1).expand(-1, -1, 3))
    log_scale = log_scale.gather(1, keep.unsqueeze(-1).expand(-1, -1, 2))
    frame_in_block = in_blocks.reshape(batch, blocks * block, 3).gather(1, frame.unsqueeze(-1).expand(-1, -1, 3))
    valid = logit > -1e3
    # Fill lies anywhere: kept in order, it is a loop like any other, of no weight.
    start = torch.minimum(start, end)
    return Loops(
        start,
        end,
        frame,
        se2.compose(frame_in_block, measured),
        log_scale,
        logit.clamp(min=-20.0),
        similarity_kept,
        valid,
    )


def loop_residuals(loops: Loops, poses: Tensor) -> Tensor:
    """Measured minus current relative pose ``(batch, loops, 3)``, positions along the axes of the map.

    Args:
        poses: global meta-poses with the origin in front ``(batch, blocks + 1, 3)``.
    """
    start = poses.gather(1, loops.start.unsqueeze(-1).expand(-1, -1, 3))
    end = poses.gather(1, (loops.end + 1).unsqueeze(-1).expand(-1, -1, 3))
    xy = start[..., :2] + se2.rotate(start[..., 2], loops.measured[..., :2]) - end[..., :2]
    yaw = se2.wrap(start[..., 2] + loops.measured[..., 2] - end[..., 2])
    return torch.cat((xy, yaw.unsqueeze(-1)), dim=-1)


def spread_over_span(loops: Loops, values: Tensor, weights: Tensor, blocks: int) -> tuple[Tensor, Tensor]:
    """Spread a value of each loop evenly over its meta-steps, and average over the loops.

    Args:
        values: ``(batch, loops, channels)``; weights: ``(batch, loops)``.

    Returns:
        Weighted mean of value / length ``(batch, blocks, channels)`` and sum of weights ``(batch, blocks, 1)``.
    """
    length = (loops.end - loops.start + 1).unsqueeze(-1)
    payload = torch.cat((values / length * weights.unsqueeze(-1), weights.unsqueeze(-1)), dim=-1)
    edges = payload.new_zeros(payload.shape[0], blocks + 1, payload.shape[2])
    edges = edges.scatter_add(1, loops.start.unsqueeze(-1).expand_as(payload), payload)
    edges = edges.scatter_add(1, (loops.end + 1).unsqueeze(-1).expand_as(payload), -payload)
    spread = edges.cumsum(dim=1)[:, :-1]
    total = spread[..., -1:].clamp(min=0.0)
    return spread[..., :-1] / (total + 1e-3), total
