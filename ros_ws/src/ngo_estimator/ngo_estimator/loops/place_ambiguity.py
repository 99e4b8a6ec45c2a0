"""Frames that look like every place show none: a white wall, a dead camera, weights that know nothing of this world."""

from __future__ import annotations

import torch
from torch import Tensor

ALIKE = 0.9  # Similarity from which on two frames look the same.

FEWEST_PLACES, LARGEST_SHARE = 10, 0.3
"""A frame that looks like at least so many places, and like more than this share of all, shows no place.

In validation mazes a frame looks like 8 places at most, and like a fifth of all.
"""


def places_by_odometry(positions: Tensor, size_m: float) -> Tensor:
    """Numbers ``(..., frames)``, from 0 on, of the squares of ``size_m`` that positions ``(..., frames, 2)`` lie in."""
    squares = torch.floor(positions / size_m).long()
    keys = squares[..., 0] * 2**20 + squares[..., 1]
    ordered, order = keys.sort(dim=-1)
    new = torch.nn.functional.pad((ordered[..., 1:] != ordered[..., :-1]).long(), (1, 0))
    return torch.empty_like(keys).scatter_(-1, order, new.cumsum(-1))


def looks_like_everything(similarity: Tensor, places: Tensor, visited: Tensor) -> Tensor:
    """Whether a frame looks like so many places that it shows none ``(...)``.

    Args:
        similarity: to other frames ``(batch, n, frames)``, or ``(frames,)``.
        places: of these frames, by ``places_by_odometry`` ``(batch, frames)``, or ``(frames,)``.
        visited: which of the frames are compared, of a shape that expands to that of ``similarity``.
    """
    count = places.shape[-1]  # at most, with no number read back from the device
    found = similarity.new_zeros(2, *similarity.shape[:-1], count)
    index = (places.unsqueeze(-2) if similarity.dim() > places.dim() else places).expand(similarity.shape)
    for row, which in zip(found, (visited & (similarity > ALIKE), visited), strict=True):
        row.scatter_reduce_(-1, index, which.expand(similarity.shape).to(row.dtype), "amax")
    alike, everywhere = found.sum(-1)
    return (alike >= FEWEST_PLACES) & (alike > LARGEST_SHARE * everywhere)
