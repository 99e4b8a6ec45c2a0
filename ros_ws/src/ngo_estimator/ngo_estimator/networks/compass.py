"""The compass: one scan to its pose in the lattice of a maze, up to the symmetries of that lattice.

Not in the paper. In a maze of square blocks every wall runs along one of two directions and stands on a multiple of a
block's side, so one frame tells heading modulo 90 degrees and position modulo the block, without drift. It lives
off this lattice and helps in no other world: what uses it is reported apart.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from ngo_estimator.checkpoint import load_network
from ngo_estimator.data.images import ImageFormat, to_network
from ngo_estimator.geometry.lattice import quarter_turned, reading_of, snapped

COMPASS = "compass"


@dataclass(frozen=True)
class CompassConfig:
    """What a compass is made of.

    ``block_m`` is the side of the lattice's cells, ``width`` the channels of the first convolution.
    """

    image: ImageFormat
    block_m: float
    width: int = 32
    hidden_size: int = 512

    def __post_init__(self) -> None:
        if self.image.height != 1 or self.image.channels != 4:
            raise ValueError(f"image is {self.image}; expected a row scan (height 1) of colour and depth (4 channels)")
        if not self.block_m > 0.0:
            raise ValueError(f"block_m is {self.block_m}; expected a positive length")
        if min(self.width, self.hidden_size) < 1:
            raise ValueError(f"width and hidden_size are {self.width} and {self.hidden_size}; expected at least 1")


class Compass(nn.Module):
    """One scan to its reading (``ngo_estimator.geometry.lattice``) and how far to trust it.

    Convolutions, flattened, and a linear layer give heading and position as vectors of their phases. (u, v) jumps
    where psi does: it is predicted for two charts of the heading, -45 to 45 and 0 to 90 degrees, and taken from the one
    whose seam is far from the predicted heading. In evaluation mode a reading is the mean of those of the scan and of
    its mirror image, which obeys the same lattice.
    """

    MIN_LOG_SCALE, MAX_LOG_SCALE = -8.0, 1.0
    # (channels as a multiple of the width, kernel, stride)
    _LAYERS = ((1, 7, 1), (2, 5, 2), (2, 3, 1), (3, 5, 2), (3, 3, 1), (4, 3, 2), (4, 3, 1))

    def __init__(self, config: CompassConfig) -> None:
        super().__init__()
        self.config = config
        channels, size = _CHANNELS, config.image.width
        layers: list[nn.Module] = []
        for times, kernel, stride in self._LAYERS:
            outputs = times * config.width
            layers += [nn.Conv1d(channels, outputs, kernel, stride, kernel // 2), nn.LeakyReLU(0.1, inplace=True)]
            channels, size = outputs, -(-size // stride)
        for module in layers:
            if isinstance(module, nn.Conv1d):
                nn.init.kaiming_normal_(module.weight, a=0.1)
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        self.convolutions = nn.Sequential(*layers)
        self.hidden = nn.Linear(channels * size, config.hidden_size)
        self.phases = nn.Linear(config.hidden_size, 10)
        self.log_scale = nn.Linear(config.hidden_size, 2)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Read scans ``(batch, 1, rays, 4)``.

        Returns:
            Readings ``(batch, 3)``: u and v (m, at most half a block from 0) and psi (rad, at most pi/4 from 0). The
            logarithm of their scales ``(batch, 2)``, of Laplace distributions: position in m, heading in rad.
        """
        if self.training:
            return self._read(images)
        readings, log_scale = (values.chunk(2) for values in self._read(torch.cat((images, images.flip(-2)))))
        mirrored = readings[1] * readings[1].new_tensor([1.0, -1.0, -1.0])
        both = 0.5 * (readings[0] + snapped(mirrored, readings[0], self.config.block_m))
        return reading_of(both, self.config.block_m), 0.5 * (log_scale[0] + log_scale[1])

    def _read(self, images: Tensor) -> tuple[Tensor, Tensor]:
        hidden = torch.relu(self.hidden(self.convolutions(_inputs(images, self.config.image)).flatten(1)))
        with torch.autocast(images.device.type, enabled=False):
            hidden = hidden.float()
            vectors = self.phases(hidden).unflatten(1, (5, 2))
            wall = vectors[:, 0]
            psi = 0.25 * _angle(wall)
            first, second = _angle(vectors[:, 1:]).unflatten(1, (2, 2)).unbind(1)
            second = quarter_turned(-(psi < 0.0).to(second.dtype), second)
            phase = torch.where(wall[:, :1] > 0.0, first, second)
            uv = phase * (self.config.block_m / (2.0 * math.pi))
            log_scale = self.log_scale(hidden).clamp(self.MIN_LOG_SCALE, self.MAX_LOG_SCALE)
        unit = log_scale.new_tensor([self.config.block_m, 1.0])
        return torch.cat((uv, psi.unsqueeze(1)), dim=1), log_scale + unit.log()


_CHANNELS = 6


def _inputs(images: Tensor, image: ImageFormat) -> Tensor:
    """Scans ``(batch, 1, rays, 4)`` to what the convolutions see, ``(batch, _CHANNELS, rays)``.

    The first and second differences of nearness along the rays, scaled up so that they survive bfloat16, tell the
    directions of the walls and their edges.
    """
    rays = to_network(images, image)[:, :, 0]
    near = pad(rays[:, 3:], (1, 1), mode="replicate")
    slope = 5.0 * (near[..., 2:] - near[..., :-2])
    bend = 50.0 * (near[..., 2:] - 2.0 * near[..., 1:-1] + near[..., :-2])
    return torch.cat((rays, slope, bend.clamp(-1.0, 1.0)), dim=1)


def _angle(vectors: Tensor) -> Tensor:
    """Angle (rad) of vectors ``(..., 2)``; the gradient is finite at 0."""
    return torch.atan2(vectors[..., 1], vectors[..., 0] + 1e-6)


def load_compass(weights: Path, world: str | None = None) -> tuple[Compass, dict[str, Any]]:
    """The compass in the folder ``weights``, in evaluation mode, and its description."""
    return load_network(weights / f"{COMPASS}.safetensors", COMPASS, Compass, CompassConfig, world)


@torch.inference_mode()
def read_frames(network: Compass, images: Tensor, batch_size: int = 256) -> tuple[Tensor, Tensor]:
    """Readings ``(frames, 3)`` and log scales ``(frames, 2)`` of scans ``(frames, 1, rays, 4)``, in batches."""
    readings, log_scales = zip(*(network(part) for part in images.split(batch_size)), strict=True)
    return torch.cat(readings), torch.cat(log_scales)
