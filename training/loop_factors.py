"""The loops that the classical pose graph gets: found by place codes, or known from the truth.

What ``found_loops`` gives is what our own optimizer gets. True revisits, measured by the pair head or known exactly,
tell how much of the error that remains lies in retrieval, and how much in measuring.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ngo_estimator import se2
from ngo_estimator.loop_closure import LoopSearch, find_loops, fused_measurements
from ngo_estimator.place_encoder import PairHead
from ngo_estimator.pose_aggregation import poses_in_blocks

_TOGETHER = 8  # trajectories that go through the pair head at once
EXACT_SCALE = (1e-3, 1e-3)
"""Scale (m, rad) of a loop that is known exactly."""


@dataclass(frozen=True)
class LoopFactors:
    """Loops of one trajectory, as in ``ngo_estimator.loop_closure.Loops`` without the batch and without fill.

    ``start`` (n,) and ``end`` (n,): the measurement starts at the pose before meta-step ``start`` and ends at the pose
    after meta-step ``end``. ``measured`` (n, 3) is the end seen from the start (m, m, rad), ``log_scale`` (n, 2) the
    logarithm of its scale (position in m, heading in rad), ``logit`` (n,) the belief that it is the same place.
    """

    start: np.ndarray
    end: np.ndarray
    measured: np.ndarray
    log_scale: np.ndarray
    logit: np.ndarray


def found_loops(
    pair_head: PairHead, relative: np.ndarray, codes: np.ndarray, search: LoopSearch, block: int = 8
) -> list[LoopFactors]:
    """What ``find_loops`` gives for each trajectory.

    Args:
        relative: steps ``(trajectories, steps, 3)`` of the odometry; codes: place codes ``(trajectories, steps,
            code_size)`` of the frame after each step.
        block: steps in a meta-pose.
    """
    found: list[LoopFactors] = []
    for first in range(0, len(relative), _TOGETHER):
        part = slice(first, first + _TOGETHER)
        with torch.inference_mode():
            loops = find_loops(
                pair_head, _float32(codes[part]), poses_in_blocks(_float32(relative[part]), block), search
            )
        columns = (loops.start, loops.end, loops.measured, loops.log_scale, loops.logit)
        for number, valid in enumerate(loops.valid):
            found.append(LoopFactors(*(column[number][valid].numpy() for column in columns)))
    return found


def true_revisits(
    truth: np.ndarray, search: LoopSearch, block: int = 8, radius_m: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Earlier frames ``(n,)``, and the meta-steps ``(n,)`` whose last frame is at the same place, in any heading.

    As the search by place codes, but with the nearest in position among the true poses ``(steps, 3)`` for the most
    similar, and none farther away than ``radius_m``. Of more than ``most``, every so manieth is kept.
    """
    positions = torch.from_numpy(np.array(truth[:, :2], dtype=np.float64))
    distance = torch.cdist(positions[block - 1 :: block], positions).unflatten(-1, (-1, block))
    best, best_step = distance.min(dim=-1)
    index = torch.arange(len(best))
    best = best.masked_fill(index[:, None] - index < search.min_separation, math.inf)
    frames, ends = [], []
    for _ in range(min(search.per_pose, len(best))):
        nearest, at = best.min(dim=-1, keepdim=True)
        near = nearest[:, 0] <= radius_m
        frames.append((at * block + best_step.gather(-1, at))[near, 0])
        ends.append(index[near])
        best = best.masked_fill((index - at).abs() <= search.min_apart, math.inf)
    frame, end = torch.cat(frames), torch.cat(ends)
    order = torch.argsort(end, stable=True)
    kept = order[torch.linspace(0, len(order) - 1, min(len(order), search.most)).round().long()]
    return frame[kept].numpy(), end[kept].numpy()


def measured_revisits(
    pair_head: PairHead,
    relative: np.ndarray,
    codes: np.ndarray,
    truth: np.ndarray,
    search: LoopSearch,
    block: int = 8,
) -> LoopFactors:
    """True revisits of one trajectory ``(steps, ...)`` measured as ``find_loops`` does."""
    frames, ends = true_revisits(truth, search, block)
    seen, in_blocks = _float32(codes).unsqueeze(0), poses_in_blocks(_float32(relative).unsqueeze(0), block)
    earlier, later = torch.from_numpy(frames), torch.from_numpy(ends * block + block - 1)
    with torch.inference_mode():
        measured, log_scale, _ = fused_measurements(
            pair_head, seen, in_blocks, earlier.unsqueeze(0), later.unsqueeze(0), search.views
        )
        measured = se2.compose(in_blocks.flatten(1, 2)[:, earlier], measured)
    return LoopFactors(frames // block, ends, measured[0].numpy(), log_scale[0].numpy(), _certain(frames))


def exact_revisits(truth: np.ndarray, search: LoopSearch, block: int = 8) -> LoopFactors:
    """True revisits of one trajectory ``(steps, 3)`` with their true relative poses: what perfect loops would be."""
    frames, ends = true_revisits(truth, search, block)
    start = frames // block
    poses = torch.from_numpy(np.concatenate((np.zeros((1, 3)), truth[block - 1 :: block])))
    measured = se2.between(poses[start], poses[ends + 1]).numpy()
    log_scale = np.tile(np.log(EXACT_SCALE), (len(start), 1))
    return LoopFactors(start, ends, measured, log_scale, _certain(frames))


def _certain(frames: np.ndarray) -> np.ndarray:
    """The belief in what is known to be the same place."""
    return np.full(len(frames), math.inf)


def _float32(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))
