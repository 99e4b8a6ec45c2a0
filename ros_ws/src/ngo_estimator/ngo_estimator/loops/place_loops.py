"""The loops of a trajectory that grows: the record of loops, and the belief that the optimizations had in them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.loops.loop_record import LoopRecord, rows
from ngo_estimator.loops.pair_measurement import PairMeasurement

UNWEIGHED = -1.0  # Weight of a loop that no optimisation has seen.

_BELIEVED = 0.1  # A loop with a smaller weight is forgotten when it leaves the window.


@dataclass(frozen=True)
class PlaceLoops(LoopRecord):
    """Loops that places or shared walls show, between nodes of the graph.

    ``frame`` ``(n,)`` is the earlier frame, as the number of steps before it. ``log_scale`` ``(n, 2)``, ``spread``
    ``(n, 2)``, ``logit`` ``(n,)`` and ``similarity`` ``(n,)`` are as of ``Loops``. ``most_drift`` ``(n, 3)`` is
    infinite if the odometry says enough. ``overlap`` ``(n,)`` says whether the loop was found by poses, not by its
    place. ``weight`` ``(n,)`` is the optimizer's last weight, ``UNWEIGHED`` before it had one, and ``information``
    ``(n, 3)`` what it gave the loop.
    """

    frame: np.ndarray = rows(np.int64)
    log_scale: np.ndarray = rows(np.float64, 2)
    spread: np.ndarray = rows(np.float64, 2)
    logit: np.ndarray = rows(np.float64)
    similarity: np.ndarray = rows(np.float64)
    most_drift: np.ndarray = rows(np.float64, 3)
    overlap: np.ndarray = rows(np.bool_)
    weight: np.ndarray = rows(np.float64)
    information: np.ndarray = rows(np.float64, 3)

    @property
    def start(self) -> np.ndarray:
        """The earlier node of each ``(n,)``."""
        return self.pairs[:, 0]

    @property
    def end(self) -> np.ndarray:
        """The later node of each ``(n,)``."""
        return self.pairs[:, 1]

    def frames(self, nodes: np.ndarray) -> np.ndarray:
        """See ``LoopRecord.frames``; a loop begins at a frame near its earlier node."""
        return np.stack((self.frame + 1, nodes[self.end]), axis=1)

    @classmethod
    def found(
        cls,
        start: np.ndarray,
        end: int,
        frame: np.ndarray,
        measurement: PairMeasurement,
        logit: np.ndarray,
        similarity: np.ndarray,
        overlap: bool,
    ) -> PlaceLoops:
        """Loops from the nodes ``start`` ``(n,)`` to one node ``end``, just found."""
        count = len(start)
        return cls(
            pairs=np.stack((start, np.full(count, end)), axis=1),
            relative=measurement.measured.double().numpy(),
            frame=frame,
            log_scale=measurement.log_scale.double().numpy(),
            spread=measurement.spread.double().numpy(),
            logit=logit,
            similarity=similarity,
            most_drift=np.full((count, 3), np.inf),
            overlap=np.full(count, overlap),
            weight=np.full(count, UNWEIGHED),
            information=np.full((count, 3), UNWEIGHED),
        )

    def best(self, numbers: np.ndarray, most: int) -> np.ndarray:
        """At most ``most`` of these loops, in their order: the likeliest, and of equal ones those measured best."""
        if len(numbers) <= most:
            return numbers
        logit = self.logit[numbers]
        least = np.partition(logit, -most)[-most]
        chosen, equal = logit > least, np.flatnonzero(logit == least)
        if len(equal) > 1:
            equal = equal[np.argsort(self.log_scale[numbers[equal], 1], kind="stable")]
        chosen[equal[: most - np.count_nonzero(chosen)]] = True
        best: np.ndarray = numbers[chosen]
        return best

    def without_doubtful(self, first: int, most: int) -> PlaceLoops:
        """The loops, of those that end before node ``first`` only the believed ones, and at most ``most`` of them."""
        behind = self.end <= first
        if not behind.any():
            return self
        # While nothing is optimised, the pair head's own belief decides.
        believed = np.where(self.weight == UNWEIGHED, self.logit > 0.0, self.weight >= _BELIEVED)
        kept = self.best(np.flatnonzero(behind & believed), most)
        return self[np.concatenate((kept, np.flatnonzero(~behind)))]

    def check_state(self) -> None:
        """Raise ``StateError`` about restored loops that are none."""
        forward = (self.start >= 0) & (self.start < self.end) & (self.frame >= -1)
        require(bool(forward.all()), "a loop does not lead from an earlier node to a later one")

    def for_optimizer(self, length: np.ndarray, valid: np.ndarray, embeddings: np.ndarray) -> Loops:
        """The record in float32.

        Args:
            length: blocks on each loop ``(n,)``; valid: which of them may count ``(n,)``.
            embeddings: of the frames at the ends of the window's blocks ``(blocks, embedding_size)``.
        """

        def single(values: np.ndarray) -> Tensor:
            return _batch(values.astype(np.float32))

        return Loops(
            start=_batch(self.start),
            end=_batch(self.end - 1),
            frame=_batch(self.frame),
            measured=single(self.relative),
            log_scale=single(self.log_scale),
            spread=single(self.spread),
            logit=single(np.maximum(self.logit, -20.0)),
            similarity=single(self.similarity),
            valid=_batch(valid),
            embeddings=_batch(embeddings),
            by_poses=_batch(self.overlap),
            length=_batch(length),
            most_drift=single(self.most_drift),
        )

    def thinned(self, keep: np.ndarray, poses: np.ndarray, variance: np.ndarray, begins: np.ndarray) -> PlaceLoops:
        """The loops after key frames went: each loop of such a key frame now begins or ends at the one before it.

        Args:
            keep: which nodes stay ``(nodes,)``.
            poses: of the key frames, the first nodes ``(k, 3)``, with the ``variance`` ``(k, 3)`` of the relative pose
                from each to the next.
            begins: numbers of the steps with which the blocks behind the nodes begin ``(nodes,)``.
        """
        staying, number = np.flatnonzero(keep), np.cumsum(keep) - 1
        drift = np.concatenate((np.zeros((1, 3)), np.cumsum(variance, axis=0)))
        measured, log_scale = self.relative.copy(), self.log_scale.copy()
        frame, pairs = self.frame.copy(), self.pairs.copy()
        for side, old in enumerate(pairs.T):
            gone = np.flatnonzero(~keep[old])
            here, there = old[gone], staying[number[old[gone]]]
            moved = torch.from_numpy(measured[gone])
            ends_at = [torch.from_numpy(poses[k]) for k in (there, here)]
            if side == 0:
                moved = se2.compose(se2.between(*ends_at), moved)
                frame[gone] = begins[there] - 1
            else:
                moved = se2.compose(moved, se2.between(*reversed(ends_at)))
            more = drift[here] - drift[there]
            # An error of the heading on the way swings everything behind it.
            lever = np.square(moved.numpy()[:, :2]).sum(1) + np.square(poses[here] - poses[there])[:, :2].sum(1)
            scales = np.stack((more[:, :2].mean(1) + more[:, 2] * lever, more[:, 2]), axis=1)
            measured[gone] = moved.numpy()
            log_scale[gone] = 0.5 * np.log(np.exp(2.0 * log_scale[gone]) + scales)
            old[gone] = there
        moved_loops = replace(self, pairs=number[pairs], relative=measured, frame=frame, log_scale=log_scale)
        start, end = pairs.T
        distinct = start < end
        # Of several loops between the same two key frames the likeliest one says nearly all.
        order = np.lexsort((-self.logit, end, start))
        again = (np.diff(start[order]) == 0) & (np.diff(end[order]) == 0)
        distinct[order[1:][again & (end[order[1:]] < len(poses))]] = False
        return moved_loops[distinct]


def _batch(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).unsqueeze(0)
