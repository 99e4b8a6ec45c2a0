"""The convolutions of FlowNetS, for images and for row scans."""

import math
from itertools import islice

import torch
from torch import Tensor, nn

# (output channels at width 1, kernel, stride) of conv1 ... conv6 of FlowNetSimple (Dosovitskiy et al., 2015).
_LAYERS = (
    (64, 7, 2),
    (128, 5, 2),
    (256, 5, 2),
    (256, 3, 1),
    (512, 3, 2),
    (512, 3, 1),
    (512, 3, 2),
    (512, 3, 1),
    (1024, 3, 2),
)


_EARLY = 2
"""Convolutions whose output still tells columns of the image from each other: it is a quarter as high and wide."""


class FlowNetConvolutions(nn.Module):
    """Nine convolutions with leaky ReLU; the channels are FlowNetS's times ``width``.

    An image of height 1 is a row scan: it gets 1-D convolutions along its columns.

    Input ``(batch, channels, height, width)``, output ``(batch, output_size)``, flattened.
    """

    def __init__(self, channels: int, image_size: tuple[int, int], width: float) -> None:
        super().__init__()
        self.is_scan = image_size[0] == 1
        convolution = nn.Conv1d if self.is_scan else nn.Conv2d
        layers: list[nn.Module] = []
        for full, kernel, stride in _LAYERS:
            outputs = max(8, 8 * round(full * width / 8))
            layers += [
                convolution(channels, outputs, kernel, stride, kernel // 2),
                nn.LeakyReLU(0.1, inplace=True),
            ]
            channels = outputs
            if len(layers) == 2 * _EARLY:
                self.early_channels = outputs
        self.layers = nn.Sequential(*layers)
        for module in self.layers:
            if isinstance(module, (nn.Conv1d, nn.Conv2d)):
                nn.init.kaiming_normal_(module.weight, a=0.1)
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        sizes = list(image_size[1:]) if self.is_scan else list(image_size)
        for number, (_, _, stride) in enumerate(_LAYERS, start=1):
            sizes = [-(-size // stride) for size in sizes]
            if number == _EARLY:
                self.early_size = tuple(sizes)
        self.output_size = channels * math.prod(sizes)

    def forward(self, image: Tensor) -> Tensor:
        return self.late(self.early(image))

    @property
    def early_layers(self) -> nn.Module:
        """The first two convolutions with what follows each."""
        return self.layers[: 2 * _EARLY]

    def early(self, image: Tensor) -> Tensor:
        """What the first two convolutions make of an image: ``(batch, early_channels, *early_size)``."""
        if self.is_scan:
            image = image.squeeze(2)
        else:
            image = image.contiguous(memory_format=torch.channels_last)
        for layer in islice(self.layers, 2 * _EARLY):
            image = layer(image)
        return image

    def late(self, early: Tensor) -> Tensor:
        """What the others make of that: ``(batch, output_size)``."""
        for layer in islice(self.layers, 2 * _EARLY, None):
            early = layer(early)
        return torch.flatten(early, 1)
