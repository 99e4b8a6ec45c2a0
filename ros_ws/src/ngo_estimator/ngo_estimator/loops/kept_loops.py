"""The loops of a trajectory that grows: the record of loops, and the belief that the optimizations had in them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.loops.pair_measurement import PairMeasurement

UNWEIGHED = -1.0
"""Weight of a loop that no optimisation has seen."""

_COLUMNS: dict[str, tuple[type, tuple[int, ...]]] = {
    "start": (np.int64, ()),
    "end": (np.int64, ()),
    "frame": (np.int64, ()),
    "measured": (np.float64, (3,)),
    "log_scale": (np.float64, (2,)),
    "spread": (np.float64, (2,)),
    "logit": (np.float64, ()),
    "similarity": (np.float64, ()),
    "most_drift": (np.float64, (3,)),
    "overlap": (np.bool_, ()),
    "weight": (np.float64, ()),
    "information": (np.float64, (3,)),
}
"""Of the record, by type and shape of a loop's row."""

_BELIEVED = 0.1
"""A loop with a smaller weight is forgotten when it leaves the window."""


@dataclass(frozen=True)
class KeptLoops:
    """``n`` loops between nodes that count the blocks from the beginning of the trajectory.

    ``start`` and ``end`` ``(n,)`` are the earlier and the later node, ``frame`` ``(n,)`` the earlier frame, as the
    number of steps before it. ``measured`` ``(n, 3)`` is the later node seen from the earlier one; ``log_scale``
    ``(n, 2)``, ``spread`` ``(n, 2)``, ``logit`` ``(n,)`` and ``similarity`` ``(n,)`` are as of ``Loops``.
    ``most_drift`` ``(n, 3)`` is infinite if the odometry tells enough; ``overlap`` ``(n,)`` says whether the loop was
    found by poses, not by its place. ``weight`` ``(n,)`` is the optimizer's last weight, ``UNWEIGHED`` before it had
    one, and ``information`` ``(n, 3)`` what it gave the loop.
    """

    start: np.ndarray
    end: np.ndarray
    frame: np.ndarray
    measured: np.ndarray
    log_scale: np.ndarray
    spread: np.ndarray
    logit: np.ndarray
    similarity: np.ndarray
    most_drift: np.ndarray
    overlap: np.ndarray
    weight: np.ndarray
    information: np.ndarray

    @classmethod
    def none(cls) -> KeptLoops:
        """No loops."""
        return cls(*(np.zeros((0, *shape), dtype) for dtype, shape in _COLUMNS.values()))

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
    ) -> KeptLoops:
        """Loops from the nodes ``start`` ``(n,)`` to one node ``end``, just found."""
        count = len(start)
        return cls(
            start=start,
            end=np.full(count, end),
            frame=frame,
            measured=measurement.measured.double().numpy(),
            log_scale=measurement.log_scale.double().numpy(),
            spread=measurement.spread.double().numpy(),
            logit=logit,
            similarity=similarity,
            most_drift=np.full((count, 3), np.inf),
            overlap=np.full(count, overlap),
            weight=np.full(count, UNWEIGHED),
            information=np.full((count, 3), UNWEIGHED),
        )

    def __len__(self) -> int:
        return len(self.weight)

    def where(self, which: np.ndarray) -> KeptLoops:
        """The loops of a boolean mask or of indices."""
        index = np.flatnonzero(which) if which.dtype == np.bool_ else which
        return KeptLoops(*(column.take(index, axis=0) for column in self._columns()))

    def and_also(self, others: KeptLoops) -> KeptLoops:
        """These and, behind them, the others."""
        return KeptLoops(*map(np.concatenate, zip(self._columns(), others._columns(), strict=True)))

    def _columns(self) -> list[np.ndarray]:
        return [getattr(self, column.name) for column in fields(self)]

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

    def without_doubtful(self, first: int, most: int) -> KeptLoops:
        """The loops, of those that end before node ``first`` only the believed ones, and at most ``most`` of them."""
        behind = self.end <= first
        if not behind.any():
            return self
        # While nothing is optimised, the pair head's own belief decides.
        believed = np.where(self.weight == UNWEIGHED, self.logit > 0.0, self.weight >= _BELIEVED)
        kept = self.best(np.flatnonzero(behind & believed), most)
        return self.where(np.concatenate((kept, np.flatnonzero(~behind))))

    def check_state(self) -> None:
        """Raise ``StateError`` about restored loops that are none."""
        columns = self._columns()
        forward = (self.start >= 0) & (self.start < self.end) & (self.frame >= -1)
        require({len(column) for column in columns} == {len(self)}, f"there are not {len(self)} loops")
        require(bool(forward.all()), "a loop does not lead from an earlier node to a later one")

    def for_optimizer(self, keys: np.ndarray, first: int, embeddings: np.ndarray) -> Loops:
        """The record in float32, numbered as the optimizer counts: key frames, and the nodes of the window behind them.

        Args:
            keys: nodes of the key frames ``(k,)``; first: the node where the window begins.
            embeddings: of the frames at the ends of the window's blocks ``(blocks, embedding_size)``.
        """

        def index(nodes: np.ndarray) -> np.ndarray:
            behind = nodes + (len(keys) - first)
            return np.where(nodes >= first, behind, np.searchsorted(keys, nodes)) if len(keys) else behind

        def single(values: np.ndarray) -> Tensor:
            return _batch(values.astype(np.float32))

        return Loops(
            start=_batch(index(self.start)),
            end=_batch(index(self.end) - 1),
            frame=_batch(self.frame),
            measured=single(self.measured),
            log_scale=single(self.log_scale),
            spread=single(self.spread),
            logit=single(np.maximum(self.logit, -20.0)),
            similarity=single(self.similarity),
            valid=torch.ones(1, len(self), dtype=torch.bool),
            embeddings=_batch(embeddings),
            by_poses=_batch(self.overlap),
            length=_batch(self.end - self.start),
            most_drift=single(self.most_drift),
        )

    def reattached(
        self, nodes: np.ndarray, stay: np.ndarray, poses: np.ndarray, variance: np.ndarray, block: int
    ) -> KeptLoops:
        """The loops after key frames went: each loop of such a key frame now begins or ends at the one before it.

        Args:
            nodes: of all key frames ``(k,)``, with their ``poses`` ``(k, 3)`` and the ``variance`` ``(k, 3)`` of the
                relative pose from each to the next.
            stay: which of them stay ``(k,)``.
            block: steps in a block.
        """
        staying = np.flatnonzero(stay)
        target = staying[np.searchsorted(staying, np.arange(len(nodes)), side="right") - 1]
        drift = np.concatenate((np.zeros((1, 3)), np.cumsum(variance, axis=0)))
        measured, log_scale = self.measured.copy(), self.log_scale.copy()
        frame, ends = self.frame.copy(), {"start": self.start.copy(), "end": self.end.copy()}
        for name, old in ends.items():
            index = np.searchsorted(nodes, old)
            gone = np.flatnonzero((index < len(nodes)) & (old <= nodes[-1]))
            gone = gone[target[index[gone]] != index[gone]]
            here, there = index[gone], target[index[gone]]
            moved = torch.from_numpy(measured[gone])
            ends_at = [torch.from_numpy(poses[k]) for k in (there, here)]
            if name == "start":
                moved = se2.compose(se2.between(*ends_at), moved)
                frame[gone] = nodes[there] * block - 1
            else:
                moved = se2.compose(moved, se2.between(*reversed(ends_at)))
            more = drift[here] - drift[there]
            # An error of the heading on the way swings everything behind it.
            lever = np.square(moved.numpy()[:, :2]).sum(1) + np.square(poses[here] - poses[there])[:, :2].sum(1)
            scales = np.stack((more[:, :2].mean(1) + more[:, 2] * lever, more[:, 2]), axis=1)
            measured[gone] = moved.numpy()
            log_scale[gone] = 0.5 * np.log(np.exp(2.0 * log_scale[gone]) + scales)
            old[gone] = nodes[there]
        moved_loops = replace(
            self, start=ends["start"], end=ends["end"], frame=frame, measured=measured, log_scale=log_scale
        )
        distinct = ends["start"] < ends["end"]
        # Of several loops between the same two key frames the likeliest one says nearly all.
        order = np.lexsort((-self.logit, ends["end"], ends["start"]))
        again = (np.diff(ends["start"][order]) == 0) & (np.diff(ends["end"][order]) == 0)
        distinct[order[1:][again & (ends["end"][order[1:]] <= nodes[-1])]] = False
        return moved_loops.where(distinct)


def _batch(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).unsqueeze(0)
