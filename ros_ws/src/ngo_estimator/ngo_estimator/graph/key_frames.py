"""Pose selection: a bounded choice of poses from before the window, which keeps old places recognisable.

Poses that leave the window come here. When there are too many, those go whose place others show and cover. What stays
forms a chain from the origin to the window, so that a correction reaches everything between.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from ngo_estimator.data.state_arrays import Arrays, taken
from ngo_estimator.geometry import se2

SLACK = 32
"""How many poses more than asked for may gather before some go: choosing costs the same for one as for many."""

_STEPS_APART = 2.0
"""Poses so many typical meta-steps apart differ as much as two that look nothing like each other."""


@dataclass(frozen=True)
class KeyFrame:
    """A pose that leaves the window, and the block of frames behind it.

    ``relative`` ``(3,)`` is the next pose as seen from it, with ``variance`` ``(3,)`` along its axes. ``embeddings``
    ``(block, embedding_size)`` are of the block's frames; ``codes`` ``(frames, code_length)`` and ``poses``
    ``(frames, 3)``, as seen from it, also of some frames before and behind.
    """

    relative: np.ndarray
    variance: np.ndarray
    embeddings: np.ndarray
    codes: np.ndarray
    poses: np.ndarray


class KeyFrames:
    """At most ``capacity`` poses (and ``SLACK`` more for a while), first to last; the origin is always one of them."""

    def __init__(self, capacity: int) -> None:
        if capacity < 2:
            raise ValueError(f"key frames are {capacity}; expected at least 2: the origin and where the window begins")
        self._capacity = capacity
        self._frames: list[KeyFrame] = []
        self._stacked: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def crowded(self) -> bool:
        """Whether it is time to ``thin``."""
        return len(self._frames) >= self._capacity + SLACK

    @property
    def relative(self) -> np.ndarray:
        """The pose after each one, which is the next or where the window begins, as seen from it ``(n, 3)``."""
        return self._stack("relative", (0, 3))

    @property
    def variance(self) -> np.ndarray:
        """Of ``relative`` ``(n, 3)``."""
        return self._stack("variance", (0, 3))

    @property
    def embeddings(self) -> np.ndarray:
        """Of the frames of each block ``(n, block, embedding_size)``."""
        return self._stack("embeddings", (0, 1, 0))

    def frame(self, index: int) -> KeyFrame:
        """The key frame of this index."""
        return self._frames[index]

    def add(self, frame: KeyFrame) -> None:
        """Add a pose behind all others."""
        self._frames.append(frame)
        self._stacked = {}

    def thin(self, poses: np.ndarray) -> np.ndarray:
        """Let go of what others cover best, until ``capacity`` are left; the first and the last always stay.

        Args:
            poses: of the key frames in the map ``(n, 3)``.

        Returns:
            Which of them stay ``(n,)``, booleans. Their ``relative`` lead over those that went.
        """
        stay = chosen(self.embeddings[:, 0], poses, self.relative, self._capacity)
        index = np.flatnonzero(stay)
        relative, variance = _merged(poses, self.variance, index)
        merged = np.diff(np.append(index, len(poses))) > 1
        self._frames = [
            replace(f, relative=relative[k], variance=variance[k]) if merged[k] else f
            for k, f in enumerate(self._frames[i] for i in index)
        ]
        self._stacked = {}
        return stay

    def state(self) -> Arrays:
        """All of them, for ``restore``; nothing where there is none."""
        if not self._frames:
            return {}
        codes, poses = (np.stack([getattr(frame, name) for frame in self._frames]) for name in ("codes", "poses"))
        own = {name: getattr(self, name) for name in ("relative", "variance", "embeddings")}
        return {**own, "codes": codes, "poses": poses}

    def restore(self, arrays: Arrays) -> None:
        """Take the key frames of a ``state()``, in place of those here; raises ``StateError``."""
        self._frames, self._stacked = [], {}
        if not arrays:
            return
        columns = (
            relative := taken(arrays, "relative", np.float64, -1, 3),
            taken(arrays, "variance", np.float64, count := len(relative), 3),
            taken(arrays, "embeddings", np.float32, count, -1, -1),
            codes := taken(arrays, "codes", np.float32, count, -1, -1),
            taken(arrays, "poses", np.float64, count, codes.shape[1], 3),
        )
        self._frames = [KeyFrame(*rows) for rows in zip(*columns, strict=True)]

    def _stack(self, name: str, empty: tuple[int, ...]) -> np.ndarray:
        if name not in self._stacked:
            rows = [getattr(frame, name) for frame in self._frames]
            self._stacked[name] = np.array(rows) if rows else np.zeros(empty)
        return self._stacked[name]


def chosen(embeddings: np.ndarray, poses: np.ndarray, relative: np.ndarray, count: int) -> np.ndarray:
    """Which of ``n`` poses to keep ``(n,)``, ``count`` of them: by novelty of the place, and spread over the map.

    Again and again the two closest are found, in the map and in what they look like, and that one goes which is closer
    to a third.

    Args:
        embeddings: unit vectors ``(n, embedding_size)``; may have no columns.
        poses: in the map ``(n, 3)``.
        relative: of the steps between them ``(n, 3)``, whose typical length is the unit of distance in the map.
    """
    xy = poses[:, :2]
    unit = _STEPS_APART * max(float(np.median(np.hypot(relative[:, 0], relative[:, 1]))), 1e-6)
    distance = np.linalg.norm(xy[:, None] - xy[None], axis=-1) / unit
    distance = np.minimum(distance, 1.0) + (1.0 - embeddings @ embeddings.T)
    np.fill_diagonal(distance, np.inf)
    stay = np.ones(len(poses), bool)
    ends = (0, len(poses) - 1)
    for _ in range(len(poses) - count):
        nearest = distance.min(axis=1)
        nearest[list(ends)] = np.inf
        first = int(nearest.argmin())
        second = int(distance[first].argmin())
        goes = first
        if second not in ends:
            other = [np.partition(distance[k], 1)[1] for k in (first, second)]
            goes = first if other[0] <= other[1] else second
        stay[goes] = False
        distance[goes], distance[:, goes] = np.inf, np.inf
    return stay


def _merged(poses: np.ndarray, variance: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative poses ``(k, 3)`` from each pose of ``index`` to the next of them, and their variances.

    The last has none after it: its rows are those of a step to itself, and mean nothing. Errors of the steps between
    add up as in ``block_variances``.
    """
    ends = np.append(index[1:], len(poses) - 1)
    start, end = torch.from_numpy(poses[index]), torch.from_numpy(poses[ends])
    relative = se2.between(start, end).numpy()
    steps = np.arange(len(poses) - 1)
    segment = np.searchsorted(index, steps, side="right") - 1
    lever = poses[ends[segment], :2] - poses[steps + 1, :2]
    lever = se2.rotate(torch.from_numpy(-poses[index[segment], 2]), torch.from_numpy(lever)).numpy()
    position, heading = variance[:-1, :2].mean(1), variance[:-1, 2]
    terms = np.stack((position + heading * lever[:, 1] ** 2, position + heading * lever[:, 0] ** 2, heading), axis=1)
    total = np.zeros((len(index), 3))
    np.add.at(total, segment, terms)
    return relative, total
