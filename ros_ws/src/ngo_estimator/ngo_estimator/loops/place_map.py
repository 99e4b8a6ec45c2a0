"""The frames of a map whose places are recognised by codes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PlaceMap:
    """The frames of a map.

    ``poses`` ``(n, 3)`` in the map, ``codes`` ``(n, code_length)``, and ``runs`` ``(n,)``: frames of the same number
    stand in their order and followed each other without a gap.
    """

    poses: np.ndarray
    codes: np.ndarray
    runs: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.poses)
        if count == 0 or self.poses.shape != (count, 3) or len(self.codes) != count or self.runs.shape != (count,):
            raise ValueError(
                f"poses, codes, runs of a map have the shapes {self.poses.shape}, {self.codes.shape}, "
                f"{self.runs.shape}; expected (n, 3), (n, code_length), (n,) with at least one frame"
            )

    @classmethod
    def of_steps(cls, numbers: np.ndarray, codes: np.ndarray, poses: np.ndarray) -> PlaceMap:
        """The frames after steps of these ``numbers`` ``(n,)``, in any order and some of them twice, with their codes.

        Args:
            poses: of all frames ``(frames, 3)``, the one before the first step in front.
        """
        steps, first = np.unique(numbers, return_index=True)
        return cls(poses[steps + 1], codes[first], np.cumsum(np.diff(steps, prepend=-1) > 1))
