"""Loops for the classical pose graph: found by place codes, or known from the truth.

``found_loops`` gives the loops of our own optimizer. True revisits show the cause of the remaining error. It is
retrieval if they help when the pair head measures them, and measurement if they help only when known exactly.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch, find_loops, frame_odometry
from ngo_estimator.loops.overlaps import find_overlaps
from ngo_estimator.loops.pair_measurement import VIEWS, PairViews, measure_pairs
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.pose_aggregation import poses_in_blocks
from ngo_estimator.ngo.registered_odometry import registered_steps

_TOGETHER = 8  # trajectories that go through the pair head at once
EXACT_SCALE = (1e-3, 1e-3)
"""Scale (m, rad) of a loop that is known exactly."""


@dataclass(frozen=True)
class LoopFactors:
    """Loops of one trajectory, as in ``ngo_estimator.loops.loop_closure.Loops`` without the batch and without fill.

    ``start`` (n,) and ``end`` (n,): the measurement starts at the pose before meta-step ``start`` and ends at the pose
    after meta-step ``end``. ``measured`` (n, 3) is the end seen from the start (m, m, rad), ``log_scale`` (n, 2) the
    logarithm of its scale (position in m, heading in rad), ``logit`` (n,) the belief that it is the same place.
    """

    start: np.ndarray
    end: np.ndarray
    measured: np.ndarray
    log_scale: np.ndarray
    logit: np.ndarray

    def and_also(self, others: "LoopFactors") -> "LoopFactors":
        """These and, behind them, the others."""
        both = zip(vars(self).values(), vars(others).values(), strict=True)
        return LoopFactors(*(np.concatenate(pair) for pair in both))


@dataclass(frozen=True)
class Seen:
    """Inputs of the search for loops, arrays ``(trajectories, steps, ...)``.

    ``relative`` and ``log_std`` are the steps of the odometry and the logarithm of their deviations, ``codes`` the
    place codes ``(trajectories, steps, code_length)`` of the frame after each step, ``origin_code`` ``(trajectories, 1,
    code_length)`` those of the first frames.
    """

    relative: np.ndarray
    log_std: np.ndarray
    codes: np.ndarray
    origin_code: np.ndarray

    def registered(self, pair_head: PairHead, search: LoopSearch, block: int) -> tuple[Tensor, Tensor]:
        """Steps and logarithms of deviations ``(trajectories, steps, 3)`` as our optimizer takes them."""
        steps, codes, origin = (_float32(array) for array in (self.relative, self.codes, self.origin_code))
        with torch.inference_mode():
            return registered_steps(
                pair_head, steps, _float32(self.log_std), codes, block, search.registrations, origin[:, 0]
            )

    def part(self, which: slice) -> "Seen":
        """Some of the trajectories."""
        return Seen(*(array[which] for array in vars(self).values()))


def registered_odometry(
    pair_head: PairHead, seen: Seen, search: LoopSearch, block: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """Steps and logarithms of deviations ``(trajectories, steps, 3)`` as our optimizer takes them."""
    parts = [part.registered(pair_head, search, block) for part in _parts(seen)]
    steps, log_std = (torch.cat(column).numpy() for column in zip(*parts, strict=True))
    return steps, log_std


def smoothed_odometry(
    smoother: OdometrySmoother, relative: np.ndarray, log_std: np.ndarray, motion: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Steps and logarithms of deviations ``(trajectories, steps, 3)`` as our optimizer smooths them."""
    with torch.inference_mode():
        steps, deviations = smoother(_float32(relative), _float32(log_std), _float32(motion))
    return steps.numpy(), deviations.numpy()


def found_loops(pair_head: PairHead, seen: Seen, search: LoopSearch, block: int = 8) -> list[LoopFactors]:
    """Loops of each trajectory by ``find_loops``, with ``block`` steps in a meta-pose."""
    found: list[LoopFactors] = []
    for part in _parts(seen):
        steps, _ = part.registered(pair_head, search, block)
        with torch.inference_mode():
            loops = find_loops(pair_head, _float32(part.codes), poses_in_blocks(steps, block), search)
        columns = (loops.start, loops.end, loops.measured, loops.log_scale, loops.logit)
        for number, valid in enumerate(loops.valid):
            found.append(LoopFactors(*(column[number][valid].numpy() for column in columns)))
    return found


MoreLoops = Callable[[np.ndarray], LoopFactors]
"""Further loops of one trajectory, under the meta-poses ``(blocks + 1, 3)`` that a graph has come to."""


def overlaps_of(
    pair_head: PairHead, codes: np.ndarray, relative: np.ndarray, search: LoopSearch, block: int = 8
) -> list[MoreLoops]:
    """A search for overlaps of each trajectory by ``find_overlaps``, once there are poses.

    Args:
        codes: place codes ``(trajectories, steps, code_length)``; relative: steps of the odometry ``(trajectories,
            steps, 3)``.

    Raises:
        ValueError: codes that hold no ranges.
    """
    if pair_head.config.registration is None:
        raise ValueError("overlaps are looked for, but the place codes hold no ranges; expected a registration")

    def more(nodes: np.ndarray, number: int) -> LoopFactors:
        of_one = slice(number, number + 1)
        seen, poses = _float32(codes[of_one]), _float32(nodes).unsqueeze(0)
        scans = pair_head.scans(seen)
        assert scans is not None
        with torch.inference_mode():
            in_blocks = poses_in_blocks(_float32(relative[of_one]), block)
            embeddings = pair_head.embed(seen[:, block - 1 :: block])
            loops = find_overlaps(scans, in_blocks, poses, embeddings, search)
        columns = (loops.start, loops.end, loops.measured, loops.log_scale, loops.logit)
        return LoopFactors(*(column[loops.valid].numpy() for column in columns))

    return [partial(more, number=number) for number in range(len(codes))]


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
    pair_head: PairHead, seen: Seen, truth: np.ndarray, search: LoopSearch, block: int = 8
) -> LoopFactors:
    """True revisits of one trajectory, alone in ``seen``, measured as ``find_loops`` does; truth: ``(steps, 3)``."""
    frames, ends = true_revisits(truth, search, block)
    codes, in_blocks = _float32(seen.codes), poses_in_blocks(seen.registered(pair_head, search, block)[0], block)
    earlier, later = torch.from_numpy(frames), torch.from_numpy(ends * block + block - 1)
    with torch.inference_mode():
        pairs = earlier.unsqueeze(0), later.unsqueeze(0)
        views = PairViews.of_trajectories(codes, frame_odometry(in_blocks), *pairs, VIEWS[: search.views])
        (measured, log_scale, _), _ = measure_pairs(pair_head, views, search.registrations)
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


def _parts(seen: Seen) -> list[Seen]:
    return [seen.part(slice(first, first + _TOGETHER)) for first in range(0, len(seen.relative), _TOGETHER)]


def _float32(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))
