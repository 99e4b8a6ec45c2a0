"""Loops between frames that see the same walls, where the poses say so: looked for once poses have been corrected.

A place is recognised by how it looks, from much the same pose. Two frames that face each other along a
corridor look nothing alike, and yet share its walls; with poses good enough to know that, their ranges are registered,
as scan matching back ends do (Hess et al. 2016).
"""

import math

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import RegistrationConfig, Scans
from ngo_estimator.graph.gauss_newton import pick
from ngo_estimator.loops.loop_closure import Loops, LoopSearch, each_from_elsewhere, frame_odometry
from ngo_estimator.loops.pair_measurement import OVERLAP_VIEWS, PairViews, measure_overlaps

OVERLAP_LOGIT = 4.0
"""Belief in a loop that was found by poses: what registers is taken for right, and kernels judge it by its residual."""

LEAST_SHARED = 0.25
"""Share of the rays that must agree before two frames are registered."""


def find_overlaps(scans: Scans, in_blocks: Tensor, nodes: Tensor, embeddings: Tensor, search: LoopSearch) -> Loops:
    """Loops between meta-poses whose frames share what they see; no gradient goes through it.

    For each meta-pose there are at most ``search.per_pose``, and ``search.overlaps`` of a trajectory: those that share
    most, as far apart from each other and in time as ``search`` has all loops.

    Args:
        in_blocks: poses within blocks ``(batch, blocks, block, 3)`` by odometry.
        nodes: meta-poses as they are now, the origin in front ``(batch, blocks + 1, 3)``.
        embeddings: of the frames at the ends of the meta-poses ``(batch, blocks, embedding_size)``.
    """
    batch, blocks, block = in_blocks.shape[:3]
    config = scans.registration
    with torch.no_grad():
        nodes, ends = nodes[:, 1:].float(), scans.ranges[:, block - 1 :: block]
        shared = _shared(config, ends, nodes, search.min_separation)
        share, earlier = each_from_elsewhere(shared, min(search.per_pose, blocks), search.min_apart, -1.0)
        later = torch.arange(blocks, device=nodes.device).repeat_interleave(share.shape[-1]).expand(batch, -1)
        share, earlier = share.flatten(1), earlier.flatten(1)
        keep = share.topk(min(search.overlaps, share.shape[1]), dim=-1).indices
        share, earlier, later = (values.gather(1, keep) for values in (share, earlier, later))
        frame, last = (at * block + block - 1 for at in (earlier, later))
        odometry = frame_odometry(in_blocks.float())
        views = PairViews.of_trajectories(scans.ranges, odometry, frame, last, OVERLAP_VIEWS)
        start = se2.between(pick(nodes, earlier), pick(nodes, later))
        result, found = measure_overlaps(config, views, start, search.registrations)
        similarity = (pick(embeddings, earlier) * pick(embeddings, later)).sum(-1)
    valid = found & (share >= LEAST_SHARED)
    return Loops(
        start=torch.where(valid, earlier + 1, later),
        end=later,
        frame=frame,
        measured=result.measured,
        log_scale=result.log_scale,
        spread=result.spread,
        logit=torch.full_like(share, OVERLAP_LOGIT),
        similarity=similarity,
        valid=valid,
        embeddings=embeddings,
    )


def _shared(config: RegistrationConfig, ranges: Tensor, poses: Tensor, min_separation: int) -> Tensor:
    """What each frame shares with each earlier one ``(batch, frames, frames)``, negative where that is not asked for.

    Args:
        ranges: ``(batch, frames, rays)``; poses: ``(batch, frames, 3)``.
    """
    batch, frames = poses.shape[:2]
    index = torch.arange(frames, device=poses.device)
    far = torch.cdist(poses[..., :2], poses[..., :2])
    seen_m = ranges.amax(dim=-1)
    near = (far < torch.minimum(seen_m.unsqueeze(-1), seen_m.unsqueeze(-2))) & (
        index[:, None] - index >= min_separation
    )
    which, later, earlier = near.nonzero(as_tuple=True)
    relative = se2.between(poses[which, earlier], poses[which, later])
    shared = poses.new_full((batch, frames, frames), -1.0)
    shared[which, later, earlier] = shared_views(config, ranges[which, earlier], ranges[which, later], relative)
    return shared


def shared_views(config: RegistrationConfig, a: Tensor, b: Tensor, relative: Tensor) -> Tensor:
    """Share of the rays ``(n,)`` that end where the other frame sees a wall as well: the smaller one of both.

    Args:
        a, b: ranges ``(n, rays)`` in m, 0 where nothing is known; relative: pose of ``b`` in the frame of ``a``
            ``(n, 3)``.
    """
    angles = config.angles_rad.numpy().astype(np.float64)
    first, second, poses = (x.detach().float().cpu().contiguous().numpy() for x in (a, b, relative))
    half = math.radians(config.field_of_view_deg) / 2.0
    share = np.empty(len(relative), np.float32)
    settings = (half, config.noise_m, config.noise_share)
    # The compiler's library takes 100 MB: only those pay for it that compare.
    from ngo_estimator.loops.shared_views_kernel import share_views

    share_views(first, second, poses, np.cos(angles), np.sin(angles), settings, share)
    return torch.from_numpy(share).to(relative)
