"""Compass readings in a trajectory: where its poses lie on the lattice, and what these say of each other.

Not in the paper, and of use in lattice mazes alone.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.lattice import initial_lattice, reading_of, snapped
from ngo_estimator.optimizer.gauss_newton import Factors, pair_factors, pick

_FIRST_FRAMES = 32
"""Frames from the origin on that tell where the lattice lies: there the odometry has hardly drifted."""
_LATTICE_STD = (0.05, 0.05, 0.02)
"""How well they tell it (m, m, rad), with room to spare: it holds the lattice where no reading is believed."""


@dataclass(frozen=True)
class CompassFixes:
    """Readings of meta-poses, and of frames near the origin taken back to it, ``(batch, fixes)`` each.

    ``node`` indexes the global meta-poses with the origin in front; ``readings`` ``(batch, fixes, 3)`` and
    ``log_scale`` ``(batch, fixes, 2)`` are as in ``ngo_estimator.geometry.lattice``; ``lattice`` ``(batch, 3)`` is a
    first estimate of the lattice's pose in the map.
    """

    node: Tensor
    readings: Tensor
    log_scale: Tensor
    lattice: Tensor
    block_m: float


def frames_to_read(steps: int, block: int) -> Tensor:
    """The frames of a trajectory that a compass has to read: the first ones, and the ends of the meta-poses."""
    frames = set(range(min(_FIRST_FRAMES, steps + 1))) | set(range(0, steps + 1, block))
    return torch.tensor(sorted(frames))


def compass_fixes(
    readings: Tensor, log_scale: Tensor, relative: Tensor, log_std: Tensor, block: int, block_m: float
) -> CompassFixes:
    """Choose how the readings of a trajectory are used.

    Args:
        readings, log_scale: of ``frames_to_read`` ``(batch, frames, 3)``, ``(batch, frames, 2)``; the first frame is
            the origin.
        relative, log_std: the odometry ``(batch, steps, 3)``.
        block: steps in a meta-pose.
        block_m: side of the lattice's cells.
    """
    batch, steps, _ = relative.shape
    frames = frames_to_read(steps, block).to(relative.device)
    poses = torch.cat((torch.zeros_like(relative[:, :1]), se2.r2g(relative)), dim=1)
    near = torch.arange(min(block, steps + 1), device=relative.device)  # the first frames are read, each of them
    ends = torch.nonzero((frames > 0) & (frames % block == 0)).squeeze(-1)
    # Taken back to the origin, a reading has the errors of the odometry between, too.
    at_origin = reading_of(se2.compose(readings[:, near], se2.between(poses[:, near], poses[:, :1])), block_m)
    variance = torch.exp(2.0 * log_std)
    variance = torch.stack((variance[..., :2].mean(-1), variance[..., 2]), dim=-1).cumsum(1)
    variance = torch.cat((torch.zeros_like(variance[:, :1]), variance), dim=1)[:, near]
    origin_scale = 0.5 * torch.log(torch.exp(2.0 * log_scale[:, near]) + variance)
    node = torch.cat((torch.zeros_like(near), frames[ends] // block)).expand(batch, -1)
    first = slice(0, min(_FIRST_FRAMES, steps + 1))
    return CompassFixes(
        node=node,
        readings=torch.cat((at_origin, readings[:, ends]), dim=1),
        log_scale=torch.cat((origin_scale, log_scale[:, ends]), dim=1),
        lattice=initial_lattice(readings[:, first], log_scale[:, first], poses[:, first], block_m),
        block_m=block_m,
    )


class CompassGate(nn.Module):
    """How much each compass reading is trusted, from its scales and residual.

    Untrained it is a robust kernel that allows for what the trajectory may still have drifted.
    """

    WIDTH = 9.0  # of the kernel, in squared deviations
    SURE = 4.0  # deviations of the drift that have to fit into half a cell: else nobody knows which cell it is

    def __init__(self, hidden: int = 16) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(5, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.head = nn.Linear(hidden, 2)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, fixes: CompassFixes, residuals: Tensor, drift: Tensor) -> Tensor:
        """Information ``(batch, fixes, 3)`` of readings with ``residuals`` and variances ``drift``, both so too."""
        variance = torch.exp(2.0 * fixes.log_scale)
        position = residuals[..., :2].square().sum(-1) / (2.0 * variance[..., 0])
        heading = residuals[..., 2].square() / variance[..., 1]
        inputs = torch.stack(
            (
                fixes.log_scale[..., 0] + 6.0,
                fixes.log_scale[..., 1] + 6.0,
                torch.log1p(position) / 3.0,
                torch.log1p(heading) / 3.0,
                (fixes.node == 0).to(position.dtype),
            ),
            dim=-1,
        )
        # A reading that was snapped to a wrong cell misses by more than both its scale and the drift.
        squared = residuals[..., :2].square().sum(-1) / (2.0 * variance[..., 0] + drift[..., :2].sum(-1))
        squared = squared + residuals[..., 2].square() / (variance[..., 1] + drift[..., 2])
        kernel = (1.0 + squared / self.WIDTH).reciprocal().square().unsqueeze(-1)
        sure = self.SURE**2 * drift[..., :2].amax(-1) < (0.5 * fixes.block_m) ** 2
        kernel = torch.cat((kernel * sure.unsqueeze(-1), kernel), dim=-1)
        information = kernel * torch.exp(4.0 * torch.tanh(self.head(self.layers(inputs)) / 4.0)) / variance
        return information[..., [0, 0, 1]]


def compass_factors(fixes: CompassFixes, gate: CompassGate, lattice: Tensor, poses: Tensor, drift: Tensor) -> Factors:
    """The readings as factors between the lattice, which is the node after the poses, and the poses.

    Args:
        lattice: current pose of the lattice in the map ``(batch, 3)``, float64.
        poses: current global meta-poses with the origin in front ``(batch, nodes, 3)``, float64.
        drift: how far the poses of the fixes may be off ``(batch, fixes, 3)``, as variances.
    """
    at = pick(poses, fixes.node)
    frame = lattice.unsqueeze(1)
    measured = snapped(fixes.readings.double(), se2.between(frame, at), fixes.block_m)
    in_map = se2.compose(frame, measured)
    residual = se2.wrapped(in_map - at)
    information = gate(fixes, residual.to(fixes.readings.dtype), drift.to(fixes.readings.dtype)).double()
    nodes = torch.stack((torch.full_like(fixes.node, poses.shape[1]), fixes.node), dim=-1)
    # One more: the first estimate of the lattice, as seen from the origin.
    prior = torch.cat((torch.zeros_like(nodes[:, :1, :1]), nodes[:, :1, :1]), dim=-1)
    off = se2.wrapped((fixes.lattice.double() - lattice).unsqueeze(1))
    certainty = off.new_tensor(_LATTICE_STD).square().reciprocal().expand_as(off)
    return pair_factors(
        torch.cat((nodes, prior), dim=1),
        torch.cat((poses, frame), dim=1),
        torch.cat((residual, off), dim=1),
        torch.cat((information, certainty), dim=1),
    )
