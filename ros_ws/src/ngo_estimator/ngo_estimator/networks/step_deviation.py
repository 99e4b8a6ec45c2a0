"""How far to trust a registered step: a small network scales the deviations that registration gives.

Not in the paper. Registration knows the noise of points and the directions that walls leave open. It does not know that
errors repeat from scan to scan, or that a step failed. The network learns that from drives whose truth is known, by
likelihood.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

STEP_EVIDENCE = (
    "share", "weakest", "strongest", "heading", "distance", "turn", "disagreement", "searched", "unsure", "wheels",
    "expected_m", "expected_rad",
)  # fmt: skip
"""Columns of a step's evidence.

The share of points on lines; common logarithms of the deviations that the lines alone leave (m, in their weakest and
strongest direction; rad); the motion since the last key scan (m, rad); the distance from the prediction in deviations,
as log(1 + d); whether a search was needed, the scan was of no use, and wheels made the prediction; common logarithms
of the prediction's deviations (m, rad).
"""


UNSURE = STEP_EVIDENCE.index("unsure")

_MIDDLE = (0.95, -2.1, -2.35, -2.75, 0.3, 0.05, 0.3, 0.2, 0.0, 0.9, -1.2, -1.3)
_SCALE = (0.06, 0.3, 0.12, 0.25, 0.1, 0.12, 0.25, 0.3, 0.3, 0.3, 0.12, 0.15)


@dataclass(frozen=True)
class StepDeviationConfig:
    """Shape of the network: ``hidden`` units; factors lie within ``largest`` and its inverse."""

    hidden: int = 16
    largest: float = 20.0

    def __post_init__(self) -> None:
        if self.hidden < 1 or not 1.0 < self.largest < math.inf:
            raise ValueError(f"hidden, largest are {self.hidden}, {self.largest}; expected at least 1, and over 1")


class StepDeviation(nn.Module):
    """Factors on the deviations of a step's position and heading; one and one before training."""

    def __init__(self, config: StepDeviationConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("middle", torch.tensor(_MIDDLE), persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE), persistent=False)
        self.middle: Tensor
        self.scale: Tensor
        self.layers = nn.Sequential(nn.Linear(len(STEP_EVIDENCE), config.hidden), nn.Tanh())
        self.head = nn.Linear(config.hidden, 2)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, evidence: Tensor) -> Tensor:
        """Logarithms ``(..., 2)`` of the factors (position, heading), for evidence ``(..., 12)``.

        An unsure step keeps its deviations: they are the prediction's.
        """
        limit = math.log(self.config.largest)
        out = self.head(self.layers((evidence - self.middle) / self.scale))
        log_factors: Tensor = limit * (out / limit).tanh() * (1.0 - evidence[..., UNSURE, None])
        return log_factors
