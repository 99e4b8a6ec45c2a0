"""How much each loop candidate is trusted under the current poses: the optimizer's learned robust kernel."""

import torch
from torch import Tensor, nn

from ngo_estimator.loops.loop_closure import Loops


class RobustLoopGate(nn.Module):
    """How much each loop candidate is trusted, from its similarity, length and residual.

    Untrained it is a robust kernel (Geman-McClure) that allows for the drift of the odometry at first, and for less of
    it with each iteration (as in graduated non-convexity, Yang et al. 2020); the network corrects that.
    """

    POSITION_NOISE, HEADING_NOISE = 2.0, 1.0  # deviations of a measurement in units of what the pair head says
    WIDTH = 4.0  # of the kernel: a loop of this squared residual, in deviations, keeps a quarter of its weight
    ANNEALING = 0.25  # share of the drift's variance that is left for the next iteration to allow for

    def __init__(self, hidden: int = 32) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(11, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.head = nn.Linear(hidden, 3)
        noise = torch.tensor([self.POSITION_NOISE, self.HEADING_NOISE]).square()
        self.register_buffer("noise", noise, persistent=False)
        self.register_buffer("components", torch.tensor([2.0, 1.0]), persistent=False)
        self.noise: Tensor
        self.components: Tensor
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(
        self, loops: Loops, residuals: Tensor, expected_variance: Tensor, iteration: int
    ) -> tuple[Tensor, Tensor]:
        """Gate ``(batch, loops)`` in zero to one, and information ``(batch, loops, 3)`` of each loop.

        Args:
            residuals: ``(batch, loops, 3)``.
            expected_variance: what the odometry alone lets the residuals vary ``(batch, loops, 3)``.
            iteration: how many iterations came before.
        """
        # Of position and heading; a position's error has two components.
        variance = torch.exp(2.0 * loops.log_scale) * self.noise
        both = variance * self.components
        squares = residuals.square()
        errors = torch.stack((squares[..., 0] + squares[..., 1], squares[..., 2]), dim=-1)
        drift = expected_variance * self.ANNEALING**iteration
        drift = torch.stack((drift[..., 0] + drift[..., 1], drift[..., 2]), dim=-1)
        squared = (errors / (both + drift)).sum(-1, keepdim=True)
        inputs = (
            loops.description,
            loops.log_length.unsqueeze(-1) / 3.0,
            torch.log1p(errors / both) / 3.0,
            torch.log1p(squared),
            torch.full_like(squared, self.ANNEALING**iteration),
        )
        belief, scale = self.head(self.layers(torch.cat(inputs, dim=-1))).split((1, 2), dim=-1)
        kernel = (1.0 + squared / self.WIDTH).square()
        gate = torch.sigmoid((loops.logit + 2.0).unsqueeze(-1) + 4.0 * belief) * loops.valid.unsqueeze(-1) / kernel
        information = gate * torch.exp(4.0 * torch.tanh(scale / 2.0)) / variance
        return gate.squeeze(-1), information[..., [0, 0, 1]]
