"""The optimizer on a whole trajectory of any number of steps, offline."""

from dataclasses import replace

import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.meta_poses import OptimizedTrajectory
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer


@torch.inference_mode()
def optimize_offline(
    optimizer: NeuralGraphOptimizer,
    pair_head: PairHead | None,
    relative: Tensor,
    log_std: Tensor,
    motion_features: Tensor,
    place_codes: Tensor,
    origin_code: Tensor | None = None,
) -> OptimizedTrajectory:
    """Optimise one trajectory ``(steps, ...)`` of any number of steps; those after the last whole block follow it.

    Arguments as in ``NeuralGraphOptimizer``, without the batch; ``pair_head`` with loops only, and ``origin_code``
    ``(1, code_length)``, the place code of the first frame, where it is known. ``poses`` of the result is ``(1, steps,
    3)``.
    """
    steps = relative.shape[0]
    block = optimizer.config.aggregation.block
    whole = steps // block * block
    if whole == 0:
        raise ValueError(f"{steps} steps make no meta-pose; expected at least {block}")
    inputs = [value[:whole].unsqueeze(0).float() for value in (relative, log_std, motion_features, place_codes)]
    loops = None
    if optimizer.config.loops:
        if pair_head is None:
            raise ValueError("an optimizer with loops needs a pair head")
        origin = None if origin_code is None else origin_code.float()
        inputs[:2] = optimizer.registered(inputs[0], inputs[1], inputs[3], pair_head, origin)
        loops = optimizer.find_loops(inputs[0], inputs[3], pair_head)
    result: OptimizedTrajectory = optimizer(*inputs[:3], loops)
    if whole == steps:
        return result
    tail = se2.compose(result.poses[:, -1:], se2.r2g(relative[whole:].unsqueeze(0).float()))
    return replace(result, poses=torch.cat((result.poses, tail), dim=1))
