"""How an observation becomes the input of a network."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

# Depth d (m) enters as DEPTH_NEAR / (DEPTH_SOFTENING + d): near walls, which say most about motion, get most of the
# range.
_DEPTH_GAIN_M = 0.6
_DEPTH_SOFTENING_M = 0.3


@dataclass(frozen=True)
class ImageFormat:
    """Shape and type of one observation.

    ``channels`` is 3 for colour, or 4 for colour (0 to 1) and depth in metres. ``dtype`` is ``uint8`` (0 to 255) or
    ``float32``. A row scan is an image of height 1 whose first column is its leftmost ray.
    """

    height: int
    width: int
    channels: int
    dtype: str

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 8:
            raise ValueError(
                f"image is {self.height} x {self.width}; expected a height of at least 1 and a width of at least 8"
            )
        if (self.channels, self.dtype) not in ((3, "uint8"), (4, "float32")):
            raise ValueError(
                f"image has {self.channels} channels of {self.dtype}; expected 3 of uint8 (colour) or 4 of float32 "
                "(colour and depth)"
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """``(height, width, channels)``."""
        return self.height, self.width, self.channels

    def check(self, image: np.ndarray) -> None:
        """Raise ``ValueError`` unless ``image`` is an observation of this format with possible values."""
        if image.shape != self.shape or image.dtype != np.dtype(self.dtype):
            raise ValueError(f"image is {image.shape} of {image.dtype}; expected {self.shape} of {self.dtype}")
        if self.dtype == "float32" and not np.isfinite(image).all():
            raise ValueError(f"image has {int((~np.isfinite(image)).sum())} values that are not finite")
        if self.channels == 4 and (wrong := int((image[..., 3] < 0.0).sum())):
            raise ValueError(f"image has {wrong} negative depths; expected metres from 0 on")
        if self.dtype == "float32" and (wrong := int(((image[..., :3] < 0.0) | (image[..., :3] > 1.0)).sum())):
            raise ValueError(f"image has {wrong} colours out of range; expected 0 to 1")


def to_network(images: Tensor) -> Tensor:
    """Images ``(..., height, width, channels)`` as float32 ``(..., channels, height, width)``, about -0.5 to 0.5."""
    if images.dtype == torch.uint8:
        values = images.float() / 255.0 - 0.5
    else:
        depth = _DEPTH_GAIN_M / (_DEPTH_SOFTENING_M + images[..., 3:].float())
        values = torch.cat((images[..., :3].float() - 0.5, depth - 0.5), dim=-1)
    return values.movedim(-1, -3)
