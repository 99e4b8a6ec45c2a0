"""Loops and odometry for the classical pose graph: those of our own optimizer."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.loops.loop_closure import LoopSearch, find_loops
from ngo_estimator.loops.overlaps import find_overlaps
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.pose_aggregation import poses_in_blocks
from ngo_estimator.ngo.registered_odometry import registered_steps

_TOGETHER = 8  # trajectories that go through the pair head at once


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


def _parts(seen: Seen) -> list[Seen]:
    return [seen.part(slice(first, first + _TOGETHER)) for first in range(0, len(seen.relative), _TOGETHER)]


def _float32(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))
