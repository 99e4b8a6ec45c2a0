"""How far to trust a registered step: a small network scales the deviations that registration gives.

Not in the paper. Registration knows the noise of points and the directions that walls leave open. It does not know that
errors repeat from scan to scan, or that a step failed. The network learns that from drives whose truth is known, by
likelihood.
"""

import math

import torch
from torch import Tensor, nn

from ngo_estimator.networks.step_scaling import MIDDLE, SCALE, STEP_EVIDENCE, UNSURE, StepDeviationConfig


class StepDeviation(nn.Module):
    """Factors on the deviations of a step's position and heading; one and one before training."""

    def __init__(self, config: StepDeviationConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("middle", torch.tensor(MIDDLE), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE), persistent=False)
        self.middle: Tensor
        self.scale: Tensor
        self.layers = nn.Sequential(nn.Linear(len(STEP_EVIDENCE), config.hidden), nn.Tanh())
        self.head = nn.Linear(config.hidden, 2)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, evidence: Tensor) -> Tensor:
        """Logarithms ``(..., 2)`` of the factors (position, heading), for evidence ``(..., 12)``.

        An unsure step keeps its deviations: they are the prediction's. ``least`` does not limit these.
        """
        limit = math.log(self.config.largest)
        out = self.head(self.layers((evidence - self.middle) / self.scale))
        log_factors: Tensor = limit * (out / limit).tanh() * (1.0 - evidence[..., UNSURE, None])
        return log_factors
