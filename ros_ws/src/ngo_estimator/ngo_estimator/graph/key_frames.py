"""Pose selection: a bounded choice of poses from before the window, which keeps old places recognisable.

Poses that leave the window come here. When there are too many, those go whose place others show and cover. What stays
forms a chain from the origin to the window, so that a correction reaches everything between.
"""

from dataclasses import dataclass, fields

import numpy as np

from ngo_estimator.data.state_arrays import Arrays, taken

SLACK = 32
"""How many poses more than asked for may gather before some go: choosing costs the same for one as for many."""

_STEPS_APART = 2.0
"""Poses so many typical meta-steps apart differ as much as two that look nothing like each other."""


@dataclass(frozen=True)
class KeyFrame:
    """A pose that leaves the window, and the block of frames behind it.

    ``embeddings`` ``(block, embedding_size)`` are of the block's frames; ``codes`` ``(frames, code_length)`` and
    ``poses`` ``(frames, 3)``, as seen from it, also of some frames before and behind.
    """

    embeddings: np.ndarray
    codes: np.ndarray
    poses: np.ndarray


_COLUMNS = tuple(field.name for field in fields(KeyFrame))


class KeyFrames:
    """At most ``capacity`` poses (and ``SLACK`` more for a while), first to last; the origin is always one of them."""

    def __init__(self, capacity: int) -> None:
        if capacity < 2:
            raise ValueError(f"key frames are {capacity}; expected at least 2: the origin and where the window begins")
        self._capacity = capacity
        self._frames: list[KeyFrame] = []
        self._embeddings: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def crowded(self) -> bool:
        """Whether it is time to ``thin``."""
        return len(self._frames) >= self._capacity + SLACK

    @property
    def embeddings(self) -> np.ndarray:
        """Of the frames of each block ``(n, block, embedding_size)``; there must be some."""
        if self._embeddings is None:
            self._embeddings = np.stack([frame.embeddings for frame in self._frames])
        return self._embeddings

    def frame(self, index: int) -> KeyFrame:
        """The key frame of this index."""
        return self._frames[index]

    def add(self, frame: KeyFrame) -> None:
        """Add a pose behind all others."""
        self._frames.append(frame)
        self._embeddings = None

    def thin(self, poses: np.ndarray, relative: np.ndarray) -> np.ndarray:
        """Let go of what others cover best, until ``capacity`` are left; the first and the last always stay.

        Args:
            poses: of the key frames in the map ``(n, 3)``.
            relative: the steps from them ``(n, 3)``.

        Returns:
            Which of them stay ``(n,)``, booleans.
        """
        stay = chosen(self.embeddings[:, 0], poses, relative, self._capacity)
        self._frames = [self._frames[k] for k in np.flatnonzero(stay)]
        self._embeddings = None
        return stay

    def state(self) -> Arrays:
        """All of them, for ``restore``; nothing where there is none."""
        if not self._frames:
            return {}
        return {name: np.stack([getattr(frame, name) for frame in self._frames]) for name in _COLUMNS}

    def restore(self, arrays: Arrays) -> None:
        """Take the key frames of a ``state()``, in place of those here; raises ``StateError``."""
        self._frames, self._embeddings = [], None
        if not arrays:
            return
        embeddings = taken(arrays, "embeddings", np.float32, -1, -1, -1)
        codes = taken(arrays, "codes", np.float32, len(embeddings), -1, -1)
        poses = taken(arrays, "poses", np.float64, *codes.shape[:2], 3)
        self._frames = [KeyFrame(*rows) for rows in zip(embeddings, codes, poses, strict=True)]


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
