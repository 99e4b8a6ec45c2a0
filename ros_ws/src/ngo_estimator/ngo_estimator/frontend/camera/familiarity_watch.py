"""Watches how familiar observations are, and makes steps and their deviations honest where they are not (no ROS)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.relative_step import UNFAMILIAR
from ngo_estimator.networks.familiarity import HISTORY, Familiarity, change, look, told_vector
from ngo_estimator.networks.local_pose_network import NO_ACTION
from ngo_estimator.networks.place_encoder import PlaceEncoder

_REPEATED = 1e-3  # change in units of the usual one, below which a frame repeats the one before
_MOVING = 1.0  # deviations from which what is told is motion
_CHUNK = 64  # steps at once
_OF_REPEATED = 10.0  # unlikeness of a frame that repeats

NOT_FITTED = (
    "the weights do not say what input they know (no familiarity.safetensors): unlike input is not told, and "
    "deviations do not grow with it"
)
"""A line for weights without ``Familiarity``."""


@dataclass(frozen=True)
class Judged:
    """A step as it is believed: ``relative`` and ``variance`` ``(3,)``, of an observation of this ``unlikeness``.

    ``repeated``: the frame repeats the one before while actions or wheels tell motion.
    """

    relative: np.ndarray
    variance: np.ndarray
    unlikeness: float
    repeated: bool


class FamiliarityWatch:
    """The familiarity of one stream of observations.

    The distances of an observation are averaged over the last ones, and those before the first count as none. Where one
    of them passes its limit, the step lies between the network's and that of the actions or wheels. Where a picture
    changes less than usual, so does the robot move: what is told counts less. Errors of such a stretch go together:
    their deviations add up, not their variances. The first step also answers for those before it, which were taken for
    familiar.
    """

    def __init__(self, familiarity: Familiarity, encoder: PlaceEncoder) -> None:
        self._familiarity, self._encoder = familiarity.eval(), encoder
        self._config = config = familiarity.config
        self._limits, self._share = np.array(config.limits), np.array(config.told_share)
        self._told_std = np.array(config.told_std)
        self.reset()

    def reset(self) -> None:
        """Forget all observations."""
        self._mean = np.zeros(len(self._limits))
        self._together = np.zeros(3)
        self._apart: deque[np.ndarray] = deque(maxlen=self._config.memory)
        self._actions = [NO_ACTION] * HISTORY

    def restorer(self) -> Callable[[], None]:
        """Puts back what is known now of the observations so far."""
        kept = self._mean.copy(), self._together.copy(), self._apart.copy(), self._actions

        def restore() -> None:
            self._mean, self._together, self._apart, self._actions = kept

        return restore

    def judge(
        self,
        images: tuple[Tensor, Tensor],
        early: Tensor,
        actions: Sequence[int | None],
        twists: Tensor | None,
        after_gap: Sequence[bool],
        steps: tuple[Tensor, Tensor, Tensor],
    ) -> list[Judged]:
        """Judge the next ``n`` steps, in order.

        Args:
            images: the earlier and the later observation of each ``(n, height, width, channels)``.
            early: the place encoder's early features of the later ones.
            actions, twists: what led to each, ``twists`` ``(n, 3)`` mean velocities, where the networks take them.
            after_gap: whether frames are missing before each, so that earlier actions are of no account.
            steps: the network's motions ``(n, 3)``, variances ``(n, 3)`` and motion features ``(n, motion_size)``.
        """
        histories = []
        for action, gap in zip(actions, after_gap, strict=True):
            before = [NO_ACTION] * HISTORY if gap else self._actions
            self._actions = [*before[1:], NO_ACTION if action is None else action]
            histories.append(self._actions)
        known = told_vector(self._config, torch.tensor(histories), twists, len(histories))
        relative, variance, features = steps
        changed = change(*images)
        with torch.inference_mode():
            distances = self._familiarity.distances(look(early), features.float(), known, relative.float(), changed)
            others = self._familiarity.told_motion(known)
        rows = zip(distances.double().numpy(), changed.tolist(), others.double().numpy(), strict=True)
        return [self._judged(*row, relative[k], variance[k]) for k, row in enumerate(rows)]

    def judge_drive(self, images: Tensor, actions: np.ndarray | None, steps: tuple[Tensor, ...]) -> list[Judged]:
        """Judge all steps of a drive, from its beginning.

        Args:
            images: ``(n + 1, height, width, channels)``; actions: ``(n,)``, where the networks take them.
            steps: the network's motions ``(n, 3)``, variances ``(n, 3)`` and motion features ``(n, motion_size)``.
        """
        self.reset()
        relative, variance, features = steps
        found = []
        for at in torch.arange(len(relative)).split(_CHUNK):
            some = [None if actions is None else int(actions[k]) for k in at.tolist()]
            with torch.inference_mode():
                early = self._encoder.early(images[at + 1])
            pairs = images[at], images[at + 1]
            of_steps = relative[at], variance[at], features[at]
            found += self.judge(pairs, early, some, None, [False] * len(some), of_steps)
        return found

    def _judged(
        self, distances: np.ndarray, changed: float, other: np.ndarray, relative: Tensor, variance: Tensor
    ) -> Judged:
        config, own, own_variance = self._config, relative.double().numpy(), variance.double().numpy()
        moving = config.is_told and bool((np.abs(other) > _MOVING * self._told_std).any())
        repeated = moving and changed < _REPEATED * config.usual_change
        self._mean += (distances - self._mean) / config.memory
        unlikeness = float((self._mean / self._limits).max())
        if repeated:
            unlikeness = max(unlikeness, _OF_REPEATED)
        if unlikeness <= UNFAMILIAR:
            self._together[:] = 0.0
            self._apart.append(other - own)
            return Judged(own, own_variance, unlikeness, repeated)
        slower = 1.0 if repeated else min(1.0, changed / config.usual_change)
        share = np.where(self._share < 1.0, slower * self._share, self._share)
        apart = (1.0 - share) * (np.abs(other - own) if config.is_told else self._told_std)
        shared = config.disagreement * apart + (np.abs(np.sum(self._apart, axis=0)) if self._apart else 0.0)
        self._apart.clear()
        more = shared * (2.0 * self._together + shared)
        self._together += shared
        mixed = share**2 * self._told_std**2 + (1.0 - share) ** 2 * own_variance
        return Judged(share * other + (1.0 - share) * own, np.maximum(mixed, own_variance) + more, unlikeness, repeated)
