"""How much each loop candidate is trusted under the current poses: the optimizer's learned robust kernels."""

import torch
from torch import Tensor, nn

from ngo_estimator.loop_closure import Loops


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


class LearnedLoopGate(nn.Module):
    """How much each loop candidate is trusted, learned from nothing: untrained it believes the pair head."""

    def __init__(self, hidden: int = 32) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(9, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.head = nn.Linear(hidden, 3)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(
        self, loops: Loops, residuals: Tensor, expected_variance: Tensor, iteration: int
    ) -> tuple[Tensor, Tensor]:
        """As of ``RobustLoopGate``; all iterations are alike."""
        measured_variance = torch.exp(2.0 * loops.log_scale)
        position_variance, heading_variance = measured_variance.unbind(-1)
        position_error = residuals[..., :2].square().sum(-1)
        heading_error = residuals[..., 2].square()
        expected_position = expected_variance[..., :2].sum(-1)
        inputs = torch.stack(
            (
                loops.similarity,
                loops.logit / 5.0,
                loops.log_scale[..., 0],
                loops.log_scale[..., 1],
                loops.log_length / 3.0,
                torch.log1p(position_error / (2.0 * position_variance)) / 3.0,
                torch.log1p(heading_error / heading_variance) / 3.0,
                torch.log1p(position_error / (expected_position + 2.0 * position_variance)),
                torch.log1p(heading_error / (expected_variance[..., 2] + heading_variance)),
            ),
            dim=-1,
        )
        out = self.head(self.layers(inputs))
        gate = torch.sigmoid(loops.logit + 4.0 * out[..., 0]) * loops.valid
        scale = torch.exp(4.0 * torch.tanh(out[..., 1:] / 2.0))
        position = gate * scale[..., 0] / position_variance
        heading = gate * scale[..., 1] / heading_variance
        return gate, torch.stack((position, position, heading), dim=-1)
