"""Corrections of the network that are kept from one of its runs to the next."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ngo_estimator.ngo.meta_poses import Correction


@dataclass(frozen=True)
class NetworkCorrections:
    """What the network gave when it ran last, ``(iterations, blocks, 3)``, for the blocks from number ``first`` on."""

    first: int
    adjustment: np.ndarray
    stiffness: np.ndarray

    @classmethod
    def none(cls) -> "NetworkCorrections":
        """Before the network ran."""
        return cls(0, np.zeros((0, 0, 3), np.float32), np.zeros((0, 0, 0), np.float32))

    @classmethod
    def of(cls, first: int, given: Sequence[Correction]) -> "NetworkCorrections":
        """Of all iterations of one optimisation."""
        arrays = (torch.cat(parts).numpy() for parts in zip(*given, strict=True))
        return cls(first, *arrays)

    @property
    def last(self) -> int:
        """Number of the first block that the network did not see."""
        return self.first + self.stiffness.shape[1]

    def summed(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        """All adjustments, and the last stiffness, both ``(blocks, 3)``, float64; see ``for_blocks``."""
        adjustment, stiffness = np.zeros((last - first, 3)), np.empty((last - first, 3))
        seen = self.last - first
        self.adjustment[:, first - self.first :].sum(0, out=adjustment[:seen])
        stiffness[:seen], stiffness[seen:] = self.stiffness[-1, first - self.first :], self.stiffness[-1, -1]
        return adjustment, stiffness

    def for_blocks(self, first: int, last: int) -> list[Correction]:
        """The same for the blocks ``first`` to ``last`` (not included): newer ones are no less stiff than the last."""
        stiffness, adjustment = self.stiffness[:, first - self.first :], self.adjustment[:, first - self.first :]
        iterations, seen, _ = stiffness.shape
        new = np.zeros((iterations, last - first - seen, 3), np.float32)
        rows = np.hstack((adjustment, new)), np.hstack((stiffness, new + stiffness[:, -1:]))
        pairs = zip(*(torch.from_numpy(array).unsqueeze(1) for array in rows), strict=True)
        return [Correction(*pair) for pair in pairs]
