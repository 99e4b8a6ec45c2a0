"""The loops of a trajectory that grows: the record of loops, and the belief that the optimizations had in them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.state_arrays import Arrays, require, taken
from ngo_estimator.geometry import se2
from ngo_estimator.optimizer.loop_closure import Loops
from ngo_estimator.optimizer.pair_measurement import PairMeasurement

UNWEIGHED = -1.0
"""Weight of a loop that no optimisation has seen."""

_FIELDS: dict[str, tuple[type, tuple[int, ...]]] = {
    "start": (np.int64, ()),
    "end": (np.int64, ()),
    "frame": (np.int64, ()),
    "measured": (np.float64, (3,)),
    "log_scale": (np.float64, (2,)),
    "spread": (np.float64, (2,)),
    "logit": (np.float64, ()),
    "similarity": (np.float64, ()),
    "valid": (np.bool_, ()),
    "most_drift": (np.float64, (3,)),
}
"""Of the record, by type and shape of a loop's row."""

_BELIEVED = 0.1
"""A loop with a smaller weight is forgotten when it leaves the window."""


@dataclass(frozen=True)
class KeptLoops:
    """``n`` loops between nodes that count the blocks from the beginning of the trajectory.

    ``loops`` are a batch of one, in float64, without ``embeddings``; its ``most_drift`` is infinite if the odometry
    tells enough. ``weight`` ``(n,)`` is the optimizer's last weight, ``UNWEIGHED`` before it had one, and
    ``information`` ``(n, 3)`` what it gave the loop; ``overlap`` ``(n,)`` says whether the loop was found by poses, not
    by its place.
    """

    loops: Loops
    weight: np.ndarray
    overlap: np.ndarray
    information: np.ndarray

    @classmethod
    def none(cls) -> KeptLoops:
        """No loops."""
        nothing = np.zeros(0, np.int64)
        measurement = PairMeasurement(torch.zeros(0, 3), torch.zeros(0, 2), torch.zeros(0, 2))
        return cls.found(nothing, 0, nothing, measurement, np.zeros(0), np.zeros(0), overlap=False)

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
        loops = Loops(
            start=_batch(start),
            end=torch.full((1, count), end - 1),
            frame=_batch(frame),
            measured=measurement.measured.double().unsqueeze(0),
            log_scale=measurement.log_scale.double().unsqueeze(0),
            spread=measurement.spread.double().unsqueeze(0),
            logit=_batch(logit),
            similarity=_batch(similarity),
            valid=torch.ones(1, count, dtype=torch.bool),
            embeddings=torch.zeros(1, 0, 0),
            most_drift=torch.full((1, count, 3), torch.inf, dtype=torch.float64),
        )
        return cls(loops, np.full(count, UNWEIGHED), np.full(count, overlap), np.full((count, 3), UNWEIGHED))

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def start(self) -> np.ndarray:
        """The earlier node of each loop ``(n,)``."""
        return self.loops.start[0].numpy()

    @property
    def end(self) -> np.ndarray:
        """The later node of each loop ``(n,)``."""
        return self.loops.end[0].numpy() + 1

    @property
    def frame(self) -> np.ndarray:
        """The earlier frame of each loop ``(n,)``, as the number of steps before it."""
        return self.loops.frame[0].numpy()

    @property
    def measured(self) -> Tensor:
        """The later node seen from the earlier one ``(n, 3)``, float64."""
        return self.loops.measured[0]

    def where(self, which: np.ndarray) -> KeptLoops:
        """The loops of a boolean mask or of indices."""
        loops = self.loops.where(torch.from_numpy(which))
        return KeptLoops(loops, self.weight[which], self.overlap[which], self.information[which])

    def and_also(self, others: KeptLoops) -> KeptLoops:
        """These and, behind them, the others."""
        both = [
            (self.weight, others.weight), (self.overlap, others.overlap), (self.information, others.information)
        ]  # fmt: skip
        return KeptLoops(self.loops.and_also(others.loops), *(np.concatenate(pair) for pair in both))

    def best(self, numbers: np.ndarray, most: int) -> np.ndarray:
        """At most ``most`` of these loops, in their order: the likeliest, and of equal ones those measured best."""
        if len(numbers) <= most:
            return numbers
        logit = self.loops.logit[0].numpy()[numbers]
        least = np.partition(logit, -most)[-most]
        chosen, equal = logit > least, np.flatnonzero(logit == least)
        if len(equal) > 1:
            equal = equal[np.argsort(self.loops.log_scale[0, :, 1].numpy()[numbers[equal]], kind="stable")]
        chosen[equal[: most - np.count_nonzero(chosen)]] = True
        best: np.ndarray = numbers[chosen]
        return best

    def without_doubtful(self, first: int, most: int) -> KeptLoops:
        """The loops, of those that end before node ``first`` only the believed ones, and at most ``most`` of them."""
        behind = self.end <= first
        if not behind.any():
            return self
        # While nothing is optimised, the pair head's own belief decides.
        believed = np.where(self.weight == UNWEIGHED, self.loops.logit[0].numpy() > 0.0, self.weight >= _BELIEVED)
        kept = self.best(np.flatnonzero(behind & believed), most)
        return self.where(np.concatenate((kept, np.flatnonzero(~behind))))

    def state(self) -> Arrays:
        """All of it, for ``from_state``."""
        record = {name: getattr(self.loops, name)[0].numpy() for name in _FIELDS}
        return {**record, "weight": self.weight, "overlap": self.overlap, "information": self.information}

    @classmethod
    def from_state(cls, arrays: Arrays) -> KeptLoops:
        """The loops of a ``state()``; raises ``StateError``."""
        weight = taken(arrays, "weight", np.float64, -1)
        overlap, count = taken(arrays, "overlap", np.bool_, len(weight)), len(weight)
        information = taken(arrays, "information", np.float64, count, 3)
        record = {name: taken(arrays, name, dtype, count, *shape) for name, (dtype, shape) in _FIELDS.items()}
        forward = (record["start"] >= 0) & (record["start"] <= record["end"]) & (record["frame"] >= -1)
        require(bool(forward.all()), "a loop does not lead from an earlier node to a later one")
        tensors = {name: torch.from_numpy(values).unsqueeze(0) for name, values in record.items()}
        return cls(Loops(**tensors, embeddings=torch.zeros(1, 0, 0)), weight, overlap, information)  # type: ignore[arg-type]

    def for_optimizer(self, keys: np.ndarray, first: int, embeddings: np.ndarray) -> Loops:
        """The record in float32, numbered as the optimizer counts: key frames, and the nodes of the window behind them.

        Args:
            keys: nodes of the key frames ``(k,)``; first: the node where the window begins.
            embeddings: of the frames at the ends of the window's blocks ``(blocks, embedding_size)``.
        """

        def index(nodes: np.ndarray) -> Tensor:
            return _batch(np.where(nodes >= first, len(keys) + nodes - first, np.searchsorted(keys, nodes)))

        loops = self.loops
        assert loops.most_drift is not None
        return replace(
            loops,
            start=index(self.start),
            end=index(self.end) - 1,
            measured=loops.measured.float(),
            log_scale=loops.log_scale.float(),
            spread=loops.spread.float(),
            logit=loops.logit.float().clamp(min=-20.0),
            similarity=loops.similarity.float(),
            embeddings=_batch(embeddings),
            by_poses=_batch(self.overlap),
            length=_batch(self.end - self.start),
            most_drift=loops.most_drift.float(),
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
        measured, log_scale = self.measured.numpy().copy(), self.loops.log_scale[0].numpy().copy()
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
            self.loops,
            start=_batch(ends["start"]),
            end=_batch(ends["end"] - 1),
            frame=_batch(frame),
            measured=_batch(measured),
            log_scale=_batch(log_scale),
        )
        distinct = ends["start"] < ends["end"]
        # Of several loops between the same two key frames the likeliest one says nearly all.
        order = np.lexsort((-self.loops.logit[0].numpy(), ends["end"], ends["start"]))
        again = (np.diff(ends["start"][order]) == 0) & (np.diff(ends["end"][order]) == 0)
        distinct[order[1:][again & (ends["end"][order[1:]] <= nodes[-1])]] = False
        return replace(self, loops=moved_loops).where(distinct)


def _batch(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).unsqueeze(0)
