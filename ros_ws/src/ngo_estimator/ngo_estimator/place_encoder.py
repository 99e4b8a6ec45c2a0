"""The place encoder and its pair head: has this place been seen before, and from where?

Not in the paper. Features trained for relative motion carry almost no place information, so one frame gets an
encoder of its own, and a small head that compares two of its codes.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from ngo_estimator.flownet import FlowNetConvolutions
from ngo_estimator.images import ImageFormat, to_network


@dataclass(frozen=True)
class PlaceConfig:
    """What a place encoder is made of.

    ``offset_scale_m`` is the typical distance of two frames of one place: the unit of the pair head's output.
    """

    image: ImageFormat
    width: float
    offset_scale_m: float
    code_size: int = 128
    embedding_size: int = 64
    pair_hidden_size: int = 384

    def __post_init__(self) -> None:
        if not 0.0 < self.width <= 2.0:
            raise ValueError(f"width is {self.width}; expected over 0 and at most 2 (1 is FlowNetS)")
        if self.offset_scale_m <= 0.0:
            raise ValueError(f"offset_scale_m is {self.offset_scale_m}; expected a positive distance")
        if min(self.code_size, self.embedding_size, self.pair_hidden_size) < 1:
            raise ValueError("code_size, embedding_size and pair_hidden_size must be at least 1")


class PlaceEncoder(nn.Module):
    """One frame to a place code of ``code_size`` numbers."""

    def __init__(self, config: PlaceConfig) -> None:
        super().__init__()
        self.config = config
        image = config.image
        self.convolutions = FlowNetConvolutions(image.channels, (image.height, image.width), config.width)
        self.code = nn.Linear(self.convolutions.output_size, config.code_size)

    def forward(self, images: Tensor) -> Tensor:
        """Observations ``(batch, height, width, channels)`` to codes ``(batch, code_size)``."""
        return self.code(self.convolutions(to_network(images, self.config.image))).float()


class PairHead(nn.Module):
    """Compares place codes: an embedding to retrieve with, and the relative pose of a pair with its uncertainty."""

    def __init__(self, config: PlaceConfig) -> None:
        super().__init__()
        self.config = config
        self.embedding = nn.Linear(config.code_size, config.embedding_size)
        hidden = config.pair_hidden_size
        self.layers = nn.Sequential(
            nn.Linear(3 * config.code_size, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, 7),
        )

    def embed(self, codes: Tensor) -> Tensor:
        """Codes ``(..., code_size)`` to unit vectors ``(..., embedding_size)`` whose inner product is similarity."""
        return normalize(self.embedding(codes), dim=-1)

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Measure pairs of codes ``(..., code_size)``.

        Returns:
            Pose of ``b`` in the frame of ``a`` ``(..., 3)`` (m, m, rad), the logarithm of its scales ``(..., 2)`` (of a
            Laplace distribution: position in m, heading in rad), and the logit ``(...)`` that the two are one place.
        """
        out = self.layers(torch.cat((a, b, a * b), dim=-1))
        xy = out[..., :2] * self.config.offset_scale_m
        yaw = torch.atan2(out[..., 2], out[..., 3] + 1e-6)
        scale_offset = out.new_tensor([self.config.offset_scale_m, 1.0]).log()
        log_scale = out[..., 4:6].clamp(-6.0, 3.0) + scale_offset
        return torch.cat((xy, yaw.unsqueeze(-1)), dim=-1), log_scale, out[..., 6]
