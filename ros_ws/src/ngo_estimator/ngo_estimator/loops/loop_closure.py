"""Loop closures: the record of loops, and the search for them in whole trajectories.

A loop says where a meta-pose lies relative to an earlier frame.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.configuration import check
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import Scans
from ngo_estimator.geometry.se2 import library
from ngo_estimator.graph.gauss_newton import pick
from ngo_estimator.loops.pair_measurement import VIEWS, PairViews, measure_pairs
from ngo_estimator.loops.place_ambiguity import looks_like_everything, places_by_odometry
from ngo_estimator.networks.place_encoder import PairHead


@dataclass(frozen=True)
class LoopSearch:
    """Which pairs of frames become loop candidates."""

    per_pose: int = 4  # Candidates at most for each meta-pose.
    most: int = 512  # Candidates at most of a whole trajectory: those with the highest belief.
    min_separation: int = 6  # Meta-poses at least between a meta-pose and its candidates.
    min_apart: int = 1  # Candidates of one meta-pose are more than so many meta-poses from each other.
    views: int = 5  # Pairs of frames around a candidate between which it is measured.
    registrations: int = 0
    """Steps of a registration by ranges, for candidates and for odometry that is good enough; 0 for none."""
    overlaps: int = 0
    """Candidates more, where poses say that frames see the same (``overlaps.find_overlaps``); 0 for none."""
    least_belief: float = 0.0  # Loops that a judge holds for less likely are left out (``loop_judge``); 0 for no judge.
    drift_m: float = 0.0
    """Drift of the odometry in the first step between (m): it limits candidates; 0 for candidates from anywhere."""
    drift_rad: float = 0.0  # The same of the heading (rad); see ``may_show_one_place``.

    def __post_init__(self) -> None:
        check(self, "per_pose most min_separation", "at least 1", lambda x: x >= 1)
        check(self, "min_apart registrations overlaps", "at least 0", lambda x: x >= 0)
        check(self, "views", f"1 to {len(VIEWS)}", lambda x: 1 <= x <= len(VIEWS))
        check(self, "least_belief", "0 (loops are not judged) to below 1", lambda x: 0.0 <= x < 1.0)
        if min(self.drift_m, self.drift_rad) < 0.0 or (self.drift_m > 0.0) != (self.drift_rad > 0.0):
            raise ValueError(
                f"drift_m, drift_rad are {self.drift_m}, {self.drift_rad}; expected two positive numbers, or 0 and 0 "
                "(candidates from anywhere)"
            )
        if self.overlaps and not self.registrations:
            raise ValueError(
                f"overlaps is {self.overlaps}, registrations 0; expected steps in which they are registered"
            )


@dataclass(frozen=True)
class Loops:
    """Loop candidates of a batch, ``(batch, loops)`` each.

    ``start`` indexes the global meta-poses with the origin in front: the measurement starts at the pose before
    meta-step ``start`` and ends at the pose after meta-step ``end``, so the meta-steps ``start .. end`` lie on the
    loop. ``measured`` ``(batch, loops, 3)`` is the end's pose in the frame of the start, ``log_scale`` ``(batch,
    loops, 2)`` the logarithm of its scale (position in m, heading in rad), ``spread`` ``(batch, loops, 2)`` the
    logarithm of how far its views disagree (m, rad), ``logit`` the belief that it is the same place, ``similarity`` the
    inner product of the embeddings, ``frame`` the earlier frame itself, and ``valid`` false for fill. ``embeddings``
    ``(batch, blocks, embedding_size)`` are those of the frames at the ends of the meta-poses.

    ``by_poses`` ``(batch, loops)`` says which of them were found by poses, not by how places look; None: all alike.
    ``length`` ``(batch, loops)`` counts the meta-poses on a loop, where those between its ends stand for several each;
    ``most_drift`` ``(batch, loops, 3)`` is how far at most its residual varies by what is known without it. ``scans``
    are the frames' ranges, where overlaps are still to be looked for.

    Of a single trajectory they may be arrays without the batch in front: see ``of_single``.
    """

    start: Tensor
    end: Tensor
    frame: Tensor
    measured: Tensor
    log_scale: Tensor
    spread: Tensor
    logit: Tensor
    similarity: Tensor
    valid: Tensor
    embeddings: Tensor
    by_poses: Tensor | None = None
    length: Tensor | None = None
    most_drift: Tensor | None = None
    scans: Scans | None = None

    def where(self, which: Tensor) -> Loops:
        """The loops of a boolean mask or of indices ``(n,)``, the same for the whole batch."""
        index = which.nonzero().squeeze(-1) if which.dtype == torch.bool else which
        return self._with({name: value.index_select(1, index) for name, value in self._per_loop().items()})

    def and_also(self, others: Loops) -> Loops:
        """These and, behind them, others of the same trajectories; both have the same optional fields."""
        mine, theirs = self._per_loop(), others._per_loop()
        if mine.keys() != theirs.keys():
            raise ValueError(f"loops have {sorted(mine)}, others {sorted(theirs)}; expected the same fields")
        return self._with({name: torch.cat((value, theirs[name]), dim=1) for name, value in mine.items()})

    def of_single(self) -> Loops:
        """Those of the only trajectory as arrays ``(loops, ...)``."""
        return self._with({name: value[0].numpy() for name, value in self._per_loop().items()})

    def _per_loop(self) -> dict[str, Tensor]:
        return {name: value for name in _PER_LOOP if (value := getattr(self, name)) is not None}

    def _with(self, per_loop: Mapping[str, Tensor | np.ndarray]) -> Loops:
        return dataclasses.replace(self, **per_loop)  # type: ignore[arg-type]

    @cached_property
    def description(self) -> Tensor:
        """What gates see of each loop under all poses ``(batch, loops, 7)``."""
        of = library(self.logit)
        beliefs = of.stack((self.similarity, self.logit / 5.0), axis=-1)
        length = self.log_length[..., None] / 3.0
        seen: Tensor = of.concatenate((beliefs, self.log_scale, self.spread - self.log_scale, length), axis=-1)
        return seen

    @cached_property
    def log_length(self) -> Tensor:
        """Logarithm of how many meta-poses lie on each loop ``(batch, loops)``."""
        length = self.end - self.start + 1 if self.length is None else self.length
        of = library(self.measured)
        logarithm: Tensor = of.log(of.asarray(length, dtype=self.measured.dtype))
        return logarithm

    @cached_property
    def nodes(self) -> Tensor:
        """The two poses of each loop ``(batch, loops, 2)``, as indices of the meta-poses with the origin in front."""
        nodes: Tensor = library(self.start).stack((self.start, self.end + 1), axis=-1)
        return nodes


def find_loops(pair_head: PairHead, codes: Tensor, in_blocks: Tensor, search: LoopSearch) -> Loops:
    """For each meta-pose the most similar earlier frames, measured by the pair head; none if it looks like everything.

    The choice has no gradient, what is measured has.

    Args:
        codes: place codes ``(batch, steps, code_length)`` of the frame after each step.
        in_blocks: poses within blocks ``(batch, blocks, block, 3)``.
    """
    block = in_blocks.shape[2]
    embeddings = pair_head.embed(codes)
    at_ends = embeddings[:, block - 1 :: block]
    with torch.no_grad():
        odometry = frame_odometry(in_blocks)
        places = places_by_odometry(odometry[..., :2], 2.0 * pair_head.config.offset_scale_m)
        possible = None
        if search.drift_m:
            steps = torch.arange(odometry.shape[1], device=odometry.device)
            between = se2.between(odometry.unsqueeze(1), odometry[:, block - 1 :: block].unsqueeze(2))
            possible = may_show_one_place(between, steps[block - 1 :: block, None] - steps, search)
        similarity, frame, end = _most_similar(at_ends, embeddings, (places, possible), block, search)
        # The pair head is the costly part: it sees only what is most similar, twice as many as can be kept.
        keep = similarity.topk(min(2 * search.most, similarity.shape[1]), dim=-1).indices
        similarity, frame, end = (value.gather(1, keep) for value in (similarity, frame, end))
    measured, log_scale, logit = pair_head(pick(codes, frame), pick(codes[:, block - 1 :: block], end))
    logit = logit.masked_fill(similarity < _NONE / 2.0, -1e4)
    keep = logit.topk(min(search.most, logit.shape[1]), dim=-1).indices.sort(dim=-1).values
    frame, end, logit, similarity = (value.gather(1, keep) for value in (frame, end, logit, similarity))
    measured, log_scale = pick(measured, keep), pick(log_scale, keep)
    last = end * block + block - 1
    views = PairViews.of_trajectories(codes, frame_odometry(in_blocks), frame, last, VIEWS[: search.views])
    result, _ = measure_pairs(pair_head, views, search.registrations, (measured, log_scale))
    return Loops(
        # Fill lies anywhere: kept in order, it is a loop like any other, of no weight.
        start=torch.minimum(frame // block, end),
        end=end,
        frame=frame,
        measured=se2.compose(pick(in_blocks.flatten(1, 2), frame), result.measured),
        log_scale=result.log_scale,
        spread=result.spread,
        logit=logit.clamp(min=-20.0),
        similarity=similarity,
        valid=logit > -1e3,
        embeddings=at_ends,
        scans=pair_head.scans(codes) if search.overlaps else None,
    )


def may_show_one_place(between: Tensor, steps: Tensor, search: LoopSearch) -> Tensor:
    """Whether frames may be of one place ``(...)``, which lies within 1 m and 35 degrees, by the odometry.

    What the odometry is off grows with the root of the number of steps.

    Args:
        between: poses ``(..., 3)`` of the later frames in the earlier ones by odometry.
        steps: steps ``(...)`` between the frames.
    """
    root = steps.clamp(min=0).to(between.dtype).sqrt()
    near = between[..., :2].norm(dim=-1) <= _PLACE_M + search.drift_m * root
    return near & (se2.wrap(between[..., 2]).abs() <= _PLACE_RAD + search.drift_rad * root)


def frame_odometry(in_blocks: Tensor) -> Tensor:
    """Global poses ``(batch, steps, 3)`` of all frames by odometry."""
    ends = se2.r2g(in_blocks[..., -1, :])
    starts = torch.cat((torch.zeros_like(ends[:, :1]), ends[:, :-1]), dim=1)
    return se2.compose(starts.unsqueeze(2), in_blocks).flatten(1, 2)


_NONE = -4.0  # similarity that marks fill
_PLACE_M, _PLACE_RAD = 1.0, math.radians(35.0)


def _most_similar(
    at_ends: Tensor, embeddings: Tensor, where: tuple[Tensor, Tensor | None], block: int, search: LoopSearch
) -> tuple[Tensor, Tensor, Tensor]:
    """Similarity, earlier frame and later meta-pose ``(batch, blocks * per_pose)`` of the candidates.

    ``where`` holds the places of all frames, and which of them are possible ``(batch, blocks, frames)`` (None: all).
    """
    places, possible = where
    batch, blocks = at_ends.shape[:2]
    similarity = (at_ends @ embeddings.mT).unflatten(-1, (blocks, block))
    index = torch.arange(blocks, device=at_ends.device)
    older = index[:, None] - index >= search.min_separation
    vague = looks_like_everything(similarity.flatten(2), places, older.repeat_interleave(block, dim=-1))
    if possible is not None:
        similarity = similarity.masked_fill(~possible.unflatten(-1, (blocks, block)), _NONE)
    best, best_step = similarity.max(dim=-1)
    best = best.masked_fill(~older | vague.unsqueeze(-1), _NONE)
    values, chosen = each_from_elsewhere(best, min(search.per_pose, blocks), search.min_apart, _NONE)
    frames = chosen * block + best_step.gather(-1, chosen)
    return values.flatten(1), frames.flatten(1), index.repeat_interleave(chosen.shape[-1]).expand(batch, -1)


def each_from_elsewhere(values: Tensor, count: int, apart: int, none: float) -> tuple[Tensor, Tensor]:
    """The ``count`` best of each row ``(..., n)``, and their indices, both ``(..., count)``.

    Neighbours of a candidate would say the same again. Each candidate is more than ``apart`` away from the better
    ones; where there is none left, the value is ``none``.
    """
    places = torch.arange(values.shape[-1], device=values.device)
    chosen = []
    for _ in range(count):
        top = values.max(dim=-1, keepdim=True)
        chosen.append((top.values, top.indices))
        values = values.masked_fill((places - places[top.indices]).abs() <= apart, none)
    best, at = (torch.cat(parts, dim=-1) for parts in zip(*chosen, strict=True))
    return best, at


_PER_LOOP = (
    "start",
    "end",
    "frame",
    "measured",
    "log_scale",
    "spread",
    "logit",
    "similarity",
    "valid",
    "by_poses",
    "length",
    "most_drift",
)
