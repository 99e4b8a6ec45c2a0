"""Drives as their sensor gives them, and faults of the sensor on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from training.data.episodes import images_of
from training.data.worlds import World

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

FAULTS = ("frozen", "repeating", "noise", "lost", "black")
"""Kinds of ``faulted``: it stands still; the last 20 frames repeat; noise; lost rays, or half a picture; black."""

_REPEATED = 20  # frames
_NOISE_OF_ROW, _NOISE_OF_PICTURE = 0.3, 60.0  # deviations: m and shares of full colour; of 255
_LOST_RAYS = 0.5  # share


@dataclass(frozen=True)
class SensedDrive:
    """What a robot saw and was told, and where it was.

    ``images`` ``(n, height, width, channels)``; ``poses_xyyaw`` ``(n, 3)``; ``actions`` ``(n - 1,)`` and ``twists``
    ``(n - 1, 3)`` between the frames, where there are any.
    """

    images: Tensor
    poses_xyyaw: np.ndarray
    actions: np.ndarray | None = None
    twists: np.ndarray | None = None

    @classmethod
    def of_episode(cls, world: World, episode: Episode) -> SensedDrive:
        """An episode of a simulator."""
        return cls(images_of(world, episode), episode.poses_xyyaw, episode.actions.astype(np.int64))


def faulted(drive: SensedDrive, kind: str, begin: int, seed: int) -> SensedDrive:
    """The drive with a fault of the sensor from frame ``begin`` on; noise is drawn from ``seed``.

    Raises:
        ValueError: for a kind that is none of ``FAULTS``.
    """
    images, rng = drive.images.clone(), np.random.default_rng(seed)
    after, row = images[begin:], images.shape[1] == 1
    if kind == "frozen":
        after[:] = after[0].clone()
    elif kind == "repeating":
        last = images[max(0, begin - _REPEATED) : begin].clone()
        after[:] = last[torch.arange(len(after)) % len(last)]
    elif kind == "noise":
        noise = torch.from_numpy(rng.normal(scale=_NOISE_OF_ROW if row else _NOISE_OF_PICTURE, size=after.shape))
        noisy = (after.double() + noise).clamp(min=0.0)
        colours = slice(0, -1) if row else slice(None)
        noisy[..., colours].clamp_(max=1.0 if row else 255.0)
        after[:] = noisy.to(images.dtype)
    elif kind == "lost" and row:
        after[torch.from_numpy(rng.random(after.shape[:-1]) < _LOST_RAYS)] = 0
    elif kind == "lost":
        after[:, :, : images.shape[2] // 2] = 0
    elif kind == "black":
        after[:] = 0
    else:
        raise ValueError(f"kind is {kind!r}; expected one of {', '.join(FAULTS)}")
    return replace(drive, images=images)
