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


def loop_jacobian(loops: Loops, poses: Tensor) -> Tensor:
    """Derivative ``(batch, loops, 3, blocks, 3)`` of each loop's end pose by each relative meta-pose.

    A translation of a meta-step moves the end by as much, turned into the map; a turn swings the end about the
    pose behind the meta-step. Meta-steps outside a loop do not act on it.
    """
    blocks = poses.shape[1] - 1
    index = torch.arange(blocks, device=poses.device)
    on_loop = (index >= loops.start.unsqueeze(-1)) & (index <= loops.end.unsqueeze(-1))
    cos, sin = torch.cos(poses[:, :-1, 2]), torch.sin(poses[:, :-1, 2])
    end = poses.gather(1, (loops.end + 1).unsqueeze(-1).expand(-1, -1, 3))
    lever = end[:, :, None, :2] - poses[:, None, 1:, :2]
    cos, sin = (value.unsqueeze(1).expand(lever.shape[:3]) for value in (cos, sin))
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = (
        torch.stack((cos, -sin, -lever[..., 1]), dim=-1),
        torch.stack((sin, cos, lever[..., 0]), dim=-1),
        torch.stack((zero, zero, one), dim=-1),
    )
    return torch.stack(rows, dim=2) * on_loop[:, :, None, :, None]


def gauss_newton_correction(
    jacobian: Tensor, residuals: Tensor, step_std: Tensor, loop_information: Tensor, deviation: Tensor
) -> Tensor:
    """Total correction ``(batch, blocks, 3)`` of the relative meta-poses that best explains all loops at once.

    Minimises ``|y / step_std|^2 + sum information * (residual + J deviation - J y)^2`` in its dual form: the linear
    system has the size of the loops, not of the trajectory, and a loop of information zero has exactly no effect.

    Args:
        jacobian: ``(batch, loops, 3, blocks, 3)`` of ``loop_jacobian`` at the current poses.
        residuals: ``(batch, loops, 3)`` at the current poses.
        step_std: standard deviations ``(batch, blocks, 3)`` of the relative meta-poses.
        loop_information: inverse variances ``(batch, loops, 3)``, zero or more.
        deviation: correction already applied ``(batch, blocks, 3)``.
    """
    batch, _, _, blocks, _ = jacobian.shape
    weighted, factor = _weighted_system(jacobian, step_std, loop_information)
    # What the residuals would be without the deviation, weighted.
    target = _root(loop_information).reshape(batch, -1, 1) * residuals.reshape(batch, -1, 1)
    target = target + weighted @ (deviation / step_std).reshape(batch, 3 * blocks, 1)
    return (weighted.mT @ torch.cholesky_solve(target, factor)).reshape(batch, blocks, 3) * step_std


def end_covariance(poses: Tensor, jacobian: Tensor, step_std: Tensor, loop_information: Tensor) -> Tensor:
    """Covariance ``(batch, 3, 3)`` of the last meta-pose (x, y, yaw in the map), given the odometry and the loops.

    The odometry's covariance, carried to the end, less what the loops take away from it: a difference of numbers that
    may be close, so that float64 is needed for a positive definite result. Arguments as in ``gauss_newton_correction``,
    with ``poses`` ``(batch, blocks + 1, 3)``.
    """
    batch, _, _, blocks, _ = jacobian.shape
    ends = torch.full((batch, 1), blocks - 1, device=poses.device)
    fill = poses.new_zeros(batch, 1)
    whole = Loops(ends * 0, ends, ends, poses[:, :1], poses[:, :1, :2], fill, fill, fill > 0)
    to_end = (loop_jacobian(whole, poses) * step_std[:, None, None]).reshape(batch, 3, 3 * blocks)
    weighted, factor = _weighted_system(jacobian, step_std, loop_information)
    taken = torch.linalg.solve_triangular(factor, weighted @ to_end.mT, upper=False)
    return to_end @ to_end.mT - taken.mT @ taken


def _weighted_system(jacobian: Tensor, step_std: Tensor, loop_information: Tensor) -> tuple[Tensor, Tensor]:
    """``A = sqrt(information) J step_std`` ``(batch, 3 loops, 3 blocks)`` and the Cholesky factor of ``A A^T + 1``."""
    batch, loops, _, blocks, _ = jacobian.shape
    scaled = (jacobian * step_std[:, None, None]).reshape(batch, 3 * loops, 3 * blocks)
    weighted = _root(loop_information).reshape(batch, 3 * loops, 1) * scaled
    system = weighted @ weighted.mT
    # Loops between the same places differ by the one alone, which must not drown in the rounding of large numbers.
    trace = system.detach().diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    system.diagonal(dim1=-2, dim2=-1).add_(1.0 + 8.0 * torch.finfo(system.dtype).eps * trace)
    return weighted, torch.linalg.cholesky(system)


def _root(information: Tensor) -> Tensor:
    """Square root whose gradient at zero is zero, that of a loop without effect, and not infinite."""
    positive = information > 0.0
    return torch.where(positive, information, 1.0).sqrt() * positive


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
