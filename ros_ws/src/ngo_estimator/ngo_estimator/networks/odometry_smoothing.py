"""Odometry smoothed: every step is corrected by what the steps before it show, and mostly those after it, too.

Not in the paper, which composes the local poses as they are. The local network sees two frames, but a robot has
momentum, and what one step leaves open its neighbours often tell.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from ngo_estimator.data.configuration import check, check_positive

_UNIT = 0.1  # Correction of a step by a head that says 1, in units of ``relative_std``.
_LARGEST_INPUT = 10.0
"""Steps of more ``relative_std``, as where frames were lost, look to their neighbours as if they had so many."""


@dataclass(frozen=True)
class SmootherConfig:
    """What an odometry smoother is made of.

    ``relative_std`` (m, m, rad), how much steps differ from each other, normalises the relative poses. ``dilations``
    holds one number a convolution, of ``width`` channels each. A ``causal`` one corrects a step by itself and those
    before it alone, so that it works on the newest step, too. ``largest`` is the largest correction, in
    ``relative_std``. ``relative_bias`` (m, m, rad) is added to what it gives,
    and ``deviation_scale`` multiplies its deviations.
    """

    motion_feature_size: int
    relative_std: tuple[float, float, float]
    dilations: tuple[int, ...] = (1, 2, 4, 8, 16)
    width: int = 64
    causal: bool = False
    largest: float = 1.0
    relative_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    deviation_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        check(self, "motion_feature_size width dilations", "at least 1", lambda x: x >= 1)
        check_positive(self, "relative_std largest deviation_scale")

    @property
    def reach(self) -> int:
        """Steps on either side that a smoothed step depends on; of a causal one, steps before it."""
        return sum(self.dilations) * (2 if self.causal else 1)


class OdometrySmoother(nn.Module):
    """Residual temporal convolutions (kernel 3) over motion features and relative poses.

    A freshly initialised smoother returns its input exactly.
    """

    def __init__(self, config: SmootherConfig) -> None:
        super().__init__()
        self.config = config
        width, dilations = config.width, config.dilations
        self.first = nn.Linear(config.motion_feature_size + 6, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in dilations)
        self.convolutions = nn.ModuleList(nn.Conv1d(width, width, 3, dilation=d) for d in dilations)
        self.head = nn.Linear(width, 6)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.register_buffer("relative_std", torch.tensor(config.relative_std), persistent=False)
        self.register_buffer("relative_bias", torch.tensor(config.relative_bias), persistent=False)
        self.register_buffer("log_deviation_scale", torch.tensor(config.deviation_scale).log(), persistent=False)
        self.relative_std: Tensor
        self.relative_bias: Tensor
        self.log_deviation_scale: Tensor

    def forward(self, relative: Tensor, log_std: Tensor, motion_features: Tensor) -> tuple[Tensor, Tensor]:
        """Smoothed steps and the logarithms of their deviations, ``(batch, steps, 3)`` both, or ``(steps, 3)``.

        Args:
            relative: relative poses ``(batch, steps, 3)`` (m, m, rad), or ``(steps, 3)`` of one drive.
            log_std: logarithm of their standard deviations, likewise.
            motion_features: ``(batch, steps, motion_feature_size)``, likewise.
        """
        scaled = (relative / self.relative_std).clamp(-_LARGEST_INPUT, _LARGEST_INPUT)
        certainty = (log_std - self.relative_std.log()).clamp(-_LARGEST_INPUT, _LARGEST_INPUT)
        hidden = torch.relu(self.first(torch.cat((motion_features, scaled, certainty), dim=-1)))
        for norm, convolution, dilation in zip(self.norms, self.convolutions, self.config.dilations, strict=True):
            around = (2 * dilation, 0) if self.config.causal else (dilation, dilation)
            hidden = hidden + torch.relu(convolution(pad(norm(hidden).mT, around))).mT
        correction, scale = self.head(hidden).split(3, dim=-1)
        largest = self.config.largest
        correction = largest * torch.tanh(_UNIT / largest * correction)
        smoothed = relative + self.relative_std * correction + self.relative_bias
        return smoothed, log_std + 2.0 * torch.tanh(0.5 * scale) + self.log_deviation_scale
