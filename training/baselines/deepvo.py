"""DeepVO, the paper's baseline: Wang et al., "DeepVO: towards end-to-end visual odometry with deep recurrent
convolutional neural networks" (2017).

It is part of the results alone; the estimator does not ship it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ngo_estimator.checkpoint import load_network
from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.data.images import ImageFormat, to_network
from ngo_estimator.networks.flownet import FlowNetConvolutions

DEEPVO = "deepvo"
_HIDDEN = 1000  # units of an LSTM layer at width 1, as in the paper
_LAYERS = 2

State = tuple[Tensor, Tensor]  # Hidden and cell state of the LSTM layers, ``(layers, sequences, units)`` each.


@dataclass(frozen=True)
class DeepVOConfig:
    """Configuration of a DeepVO network.

    ``width`` scales the channels of the convolutions and the units of the LSTM layers. ``relative_mean`` and
    ``relative_std`` (m, m, rad) normalise the output, to which ``relative_bias`` is added. With ``symmetric`` the
    estimate is the mean of that of the frames and that of their mirror images, as that of our local network.
    """

    image: ImageFormat
    width: float
    relative_mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    relative_std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    relative_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    symmetric: bool = False

    def __post_init__(self) -> None:
        check(self, "width", "over 0 and at most 2 (1 is DeepVO)", lambda x: 0.0 < x <= 2.0)
        check_positive(self, "relative_std")


class DeepVO(nn.Module):
    """Relative poses from a sequence of frames: two stacked frames, nine convolutions, two LSTM layers.

    The nine convolutions are those of FlowNetS, as in DeepVO. Where it gives six degrees of freedom, this gives the
    three of a plane.
    """

    def __init__(self, config: DeepVOConfig) -> None:
        super().__init__()
        self.config = config
        image = config.image
        units = max(8, 8 * round(_HIDDEN * config.width / 8))
        self.convolutions = FlowNetConvolutions(2 * image.channels, (image.height, image.width), config.width)
        self.lstm = nn.LSTM(self.convolutions.output_size, units, _LAYERS, batch_first=True)
        self.pose = nn.Linear(units, 3)
        self.register_buffer("relative_mean", torch.tensor(config.relative_mean), persistent=False)
        self.register_buffer("relative_std", torch.tensor(config.relative_std), persistent=False)
        self.register_buffer("relative_bias", torch.tensor(config.relative_bias), persistent=False)
        self.relative_mean: Tensor
        self.relative_std: Tensor
        self.relative_bias: Tensor

    def forward(self, images: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """Estimate the motion between consecutive frames.

        Args:
            images: ``(sequences, steps + 1, height, width, channels)`` as the sensor gives them.
            state: what the last call returned, to go on from its last frame; None at the start of a trajectory.

        Returns:
            Relative poses ``(sequences, steps, 3)`` of each frame in the one before (m, m, rad), and the state.
        """
        if self.training or not self.config.symmetric:
            relative, after = self._estimate(images, state)
            return relative + self.relative_bias, after
        relative, after = self._estimate(torch.cat((images, images.flip(-2))), state)
        seen, mirrored = relative.chunk(2)
        return 0.5 * (seen + mirrored * mirrored.new_tensor([1.0, -1.0, -1.0])) + self.relative_bias, after

    def _estimate(self, images: Tensor, state: State | None) -> tuple[Tensor, State]:
        sequences, frames = images.shape[:2]
        seen = to_network(images.flatten(0, 1), self.config.image).unflatten(0, (sequences, frames))
        pairs = torch.cat((seen[:, :-1], seen[:, 1:]), dim=2).flatten(0, 1)
        features = self.convolutions(pairs).unflatten(0, (sequences, frames - 1))
        hidden, after = self.lstm(features, state)
        return self.pose(hidden).float() * self.relative_std + self.relative_mean, after


@torch.inference_mode()
def trajectory_steps(network: DeepVO, images: Tensor, chunk: int = 256) -> Tensor:
    """Relative poses ``(steps, 3)`` of a whole trajectory ``(steps + 1, height, width, channels)``, in chunks."""
    parts, state = [], None
    for first in range(0, len(images) - 1, chunk):
        relative, state = network(images[first : first + chunk + 1].unsqueeze(0), state)
        parts.append(relative[0])
    return torch.cat(parts)


def load_deepvo(weights: Path, world: str | None = None) -> tuple[DeepVO, dict[str, Any]]:
    """The network in the folder ``weights``, in evaluation mode, and its description."""
    return load_network(weights / f"{DEEPVO}.safetensors", DEEPVO, DeepVO, DeepVOConfig, world)
