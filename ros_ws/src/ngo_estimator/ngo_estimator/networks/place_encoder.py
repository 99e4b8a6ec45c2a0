"""The place encoder and its pair head: has this place been seen before, and from where?

Not in the paper. Features trained for relative motion carry almost no place information, so one frame gets an
encoder of its own, and a small head that compares two of its codes.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, normalize

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.data.images import ImageFormat, to_network
from ngo_estimator.geometry.scan_registration import RegistrationConfig, Scans, register
from ngo_estimator.networks.flownet import FlowNetConvolutions

_UNSURE = -2.0  # Logarithm of the scale from which on a range that was learned to see is left out: an eighth of itself.


@dataclass(frozen=True)
class PlaceConfig:
    """What a place encoder is made of.

    ``offset_scale_m`` is the typical distance of two frames of one place: the unit of the pair head's output.
    A code has ``code_size`` learned numbers; with ``registration`` ranges follow (m, 0 where there is none), so that
    pairs can be measured by these: those of a row with depth, or what a network says of a picture. Of a picture with a
    smaller share of sure ranges than ``least_sure`` there are none: it shows something that the network does not know.
    """

    image: ImageFormat
    width: float
    offset_scale_m: float
    code_size: int = 128
    embedding_size: int = 64
    pair_hidden_size: int = 384
    registration: RegistrationConfig | None = None
    least_sure: float = 0.0

    def __post_init__(self) -> None:
        check(self, "width", "over 0 and at most 2 (1 is FlowNetS)", lambda x: 0.0 < x <= 2.0)
        check_positive(self, "offset_scale_m")
        check(self, "code_size embedding_size pair_hidden_size", "at least 1", lambda x: x >= 1)
        check(self, "least_sure", "a share of 0 to 1", lambda x: 0.0 <= x <= 1.0)
        if self.registration is None or self.sees_ranges:
            return
        if not self.image.has_depth:
            raise ValueError(f"registration is given for images {self.image.shape}; expected a picture, or depth")
        if self.registration.rays != self.image.width:
            raise ValueError(
                f"registration has {self.registration.rays} rays; expected {self.image.width}, the image's"
            )

    @property
    def sees_ranges(self) -> bool:
        """Whether the ranges in a code are what a network says of a picture."""
        return self.registration is not None and self.image.height > 1

    @property
    def registers_odometry(self) -> bool:
        """Whether the ranges in a code are good enough to measure steps of the odometry again, and not loops alone."""
        return self.registration is not None and self.registration.odometry

    @property
    def code_length(self) -> int:
        """Numbers in a code, with the ranges behind those that are learned."""
        return self.code_size + (0 if self.registration is None else self.registration.rays)


class SeenRanges(NamedTuple):
    """How far the walls are, each ``(batch, rays)``: logarithm of the range (m), and of its scale.

    The scale is that of a Laplace distribution of the logarithm, and so a share of the range.
    """

    log_range: Tensor
    log_scale: Tensor

    @property
    def ranges(self) -> Tensor:
        """Ranges ``(batch, rays)`` in m, 0 where they are too uncertain."""
        return self.log_range.exp() * (self.log_scale < _UNSURE)


class RangeHead(nn.Module):
    """How far the walls of a picture are, from its early features, column by column."""

    CHANNELS, HIDDEN = 48, 128

    def __init__(self, channels: int, size: tuple[int, ...], rays: int) -> None:
        super().__init__()
        height, width = size
        self.rows = nn.Conv2d(channels, self.CHANNELS, 3, (2, 1), 1)
        columns: list[nn.Module] = []
        inputs = self.CHANNELS * -(-height // 2)
        for outputs, dilation in ((self.HIDDEN, 1), (self.HIDDEN, 2), (self.HIDDEN // 2, 1)):
            columns += [nn.Conv1d(inputs, outputs, 3, 1, dilation, dilation), nn.LeakyReLU(0.1)]
            inputs = outputs
        self.columns = nn.Sequential(*columns)
        self.out = nn.Linear(inputs * width, 2 * rays)

    def forward(self, early: Tensor) -> SeenRanges:
        """Early features ``(batch, channels, height, width)`` to ranges."""
        by_column = leaky_relu(self.rows(early), 0.1).flatten(1, 2)
        log_range, log_scale = self.out(self.columns(by_column).flatten(1)).float().chunk(2, dim=-1)
        return SeenRanges(log_range.clamp(-4.0, 5.0), log_scale.clamp(-7.0, 1.0))


class PlaceEncoder(nn.Module):
    """One frame to a place code of ``code_length`` numbers."""

    def __init__(self, config: PlaceConfig) -> None:
        super().__init__()
        self.config = config
        image = config.image
        self.convolutions = FlowNetConvolutions(image.channels, (image.height, image.width), config.width)
        self.code = nn.Linear(self.convolutions.output_size, config.code_size)
        if config.registration is not None and config.sees_ranges:
            rays = config.registration.rays
            self.ranges = RangeHead(self.convolutions.early_channels, self.convolutions.early_size, rays)

    def forward(self, images: Tensor) -> Tensor:
        """Observations ``(batch, height, width, channels)`` to codes ``(batch, code_length)``."""
        return self.code_of(images, self.early(images))

    def code_of(self, images: Tensor, early: Tensor) -> Tensor:
        """The codes of observations of which the ``early`` features are known."""
        code, seen = self._see(early)
        if self.config.registration is None:
            return code
        if seen is not None:
            ranges = seen.ranges
            sure = (ranges > 0.0).float().mean(dim=-1, keepdim=True) >= self.config.least_sure
            return torch.cat((code, ranges * sure), dim=-1)
        ranges = images[:, 0, :, -1].float()
        return torch.cat((code, torch.where(ranges.isfinite(), ranges, 0.0)), dim=-1)

    def see(self, images: Tensor) -> tuple[Tensor, SeenRanges | None]:
        """What is learned of observations: the first ``code_size`` numbers of their codes, and ranges of pictures."""
        return self._see(self.early(images))

    def _see(self, early: Tensor) -> tuple[Tensor, SeenRanges | None]:
        code = self.code(self.convolutions.late(early)).float()
        return code, self.ranges(early) if self.config.sees_ranges else None

    def early(self, images: Tensor) -> Tensor:
        """Early features ``(batch, channels, ...)`` of observations."""
        return self.convolutions.early(to_network(images, self.config.image))

    def keep_ranges(self) -> None:
        """Let no training change how the ranges of pictures are seen."""
        self.ranges.requires_grad_(False)
        self.convolutions.early_layers.requires_grad_(False)


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
        """Codes ``(..., code_length)`` to unit vectors ``(..., embedding_size)`` whose inner product is similarity."""
        return normalize(self.embedding(codes[..., : self.config.code_size]), dim=-1)

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Measure pairs of codes ``(..., code_length)`` by what is learned of them.

        Returns:
            Pose of ``b`` in the frame of ``a`` ``(..., 3)`` (m, m, rad), the logarithm of its scales ``(..., 2)`` (of a
            Laplace distribution: position in m, heading in rad), and the logit ``(...)`` that the two are one place.
        """
        a, b = a[..., : self.config.code_size], b[..., : self.config.code_size]
        out = self.layers(torch.cat((a, b, a * b), dim=-1))
        xy = out[..., :2] * self.config.offset_scale_m
        yaw = torch.atan2(out[..., 2], out[..., 3] + 1e-6)
        scale_offset = out.new_tensor([self.config.offset_scale_m, 1.0]).log()
        log_scale = out[..., 4:6].clamp(-6.0, 3.0) + scale_offset
        return torch.cat((xy, yaw.unsqueeze(-1)), dim=-1), log_scale, out[..., 6]

    def scans(self, codes: Tensor) -> Scans | None:
        """The ranges in codes ``(batch, steps, code_length)``; None where they hold none."""
        config = self.config.registration
        return None if config is None else Scans(codes[..., self.config.code_size :].detach().clone(), config)

    def register(self, a: Tensor, b: Tensor, start: Tensor, log_std: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Measure pairs of codes ``(..., code_length)`` by their ranges, from what is known of them already.

        Args:
            start: pose of ``b`` in the frame of ``a`` ``(..., 3)``; log_std: logarithm of its deviations ``(..., 2)``
                (position in m, heading in rad).
            steps: steps of the registration; 0 for what cannot be registered.

        Returns:
            Both, as ``scan_registration.register`` gives them.

        Raises:
            ValueError: codes that hold no ranges.
        """
        if steps == 0:
            return start, log_std
        config = self.config.registration
        if config is None:
            raise ValueError("ranges are to be registered, but the place codes hold none; expected a registration")
        return register(config, a[..., self.config.code_size :], b[..., self.config.code_size :], start, log_std, steps)
