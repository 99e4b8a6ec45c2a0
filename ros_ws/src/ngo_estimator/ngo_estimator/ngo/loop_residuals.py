"""Loops under the current poses: their residuals, the drift to expect, and the correction that they ask for."""

import torch
from torch import Tensor, nn

from ngo_estimator.geometry import se2
from ngo_estimator.graph.gauss_newton import pick
from ngo_estimator.loops.loop_closure import Loops


def loop_residuals(loops: Loops, poses: Tensor) -> Tensor:
    """Measured minus current relative pose ``(batch, loops, 3)``, positions along the axes of the map.

    Args:
        poses: global meta-poses with the origin in front ``(batch, blocks + 1, 3)``.
    """
    start, end = pick(poses, loops.start), pick(poses, loops.end + 1)
    xy = start[..., :2] + se2.rotate(start[..., 2], loops.measured[..., :2]) - end[..., :2]
    yaw = se2.wrap(start[..., 2] + loops.measured[..., 2] - end[..., 2])
    return torch.cat((xy, yaw.unsqueeze(-1)), dim=-1)


def odometry_variances(start: Tensor, end: Tensor, poses: Tensor, step_variance: Tensor) -> Tensor:
    """Variances ``(batch, n, 3)``, float64, of poses as seen from earlier ones by odometry alone.

    A turn of a meta-step swings the end about the pose behind that step; cross-correlations are dropped.

    Args:
        start, end: nodes ``(batch, n)``, the earlier and the later pose.
        poses: global meta-poses with the origin in front ``(batch, blocks + 1, 3)``.
        step_variance: of the relative meta-poses ``(batch, blocks, 3)``, along the axes of the earlier pose.
    """
    # Sums over a loop are differences of prefix sums, of which float32 would leave too few digits.
    poses, step_variance = poses.double(), step_variance.double()
    along_x = torch.cos(poses[:, :-1, 2]).square()
    position_x = along_x * step_variance[..., 0] + (1.0 - along_x) * step_variance[..., 1]
    position_y = step_variance[..., :2].sum(-1) - position_x
    position = torch.stack((position_x, position_y), dim=-1)
    turn, at = step_variance[..., 2:], poses[:, 1:, :2]
    lever = turn * at
    terms = torch.cat((position, turn, lever, lever * at), dim=-1)
    prefix = nn.functional.pad(terms.cumsum(1), (0, 0, 1, 0))
    both = pick(prefix, torch.cat((end, start), dim=1))
    position, turn, lever, squares = (both[:, : end.shape[1]] - both[:, end.shape[1] :]).split((2, 1, 2, 2), dim=-1)
    at_end = pick(poses, end)[..., :2]
    across = at_end * (at_end * turn - 2.0 * lever) + squares
    return torch.cat((position + across.flip(-1), turn), dim=-1).clamp(min=0.0)


def spread_over_span(loops: Loops, values: Tensor, weights: Tensor, blocks: int) -> tuple[Tensor, Tensor]:
    """Spread a value of each loop evenly over its meta-steps, and average over the loops.

    Args:
        values: ``(batch, loops, channels)``; weights: ``(batch, loops)``.

    Returns:
        Weighted mean of value / length ``(batch, blocks, channels)`` and sum of weights ``(batch, blocks, 1)``.
    """
    length = (loops.end - loops.start + 1).unsqueeze(-1)
    weights = weights.unsqueeze(-1)
    payload = torch.cat((values / length * weights, weights), dim=-1)
    edges = payload.new_zeros(payload.shape[0], blocks + 1, payload.shape[2])
    index = torch.cat((loops.start, loops.end + 1), dim=1).unsqueeze(-1).expand(-1, -1, payload.shape[2])
    edges = edges.scatter_add(1, index, torch.cat((payload, -payload), dim=1))
    spread = edges.cumsum(dim=1)[:, :-1]
    total = spread[..., -1:].clamp(min=0.0)
    return spread[..., :-1] / (total + 1e-3), total
