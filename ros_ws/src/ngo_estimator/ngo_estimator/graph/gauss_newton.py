"""One Gauss-Newton step of a pose graph through which gradients flow; ``normal_equations`` takes it without them.

The unknowns are all poses after the origin, in the map. Each factor compares two poses. The step minimises the sum of
squared residuals, weighted with their information. It is differentiable with respect to every tensor.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.graph.rounding import RELATIVE_JITTER


@dataclass(frozen=True)
class Factors:
    """Linearised factors ``(batch, factors)`` between pairs of nodes.

    ``nodes`` ``(batch, factors, 2)``; ``jacobian`` ``(batch, factors, 3, 6)``: derivative of the prediction by the
    poses (x, y, yaw) of both nodes; ``residual`` ``(batch, factors, 3)``: measured less predicted. ``information`` is
    the inverse covariance of the residual: whole matrices ``(batch, factors, 3, 3)``, positive semidefinite, or their
    diagonals ``(batch, factors, 3)`` if its components are independent.
    """

    nodes: Tensor
    jacobian: Tensor
    residual: Tensor
    information: Tensor

    def __post_init__(self) -> None:
        shape = tuple(self.residual.shape)
        if tuple(self.information.shape) not in (shape, (*shape, 3)):
            raise ValueError(
                f"information is of shape {tuple(self.information.shape)}; expected {shape} or {(*shape, 3)}"
            )

    @property
    def weighted_jacobian(self) -> Tensor:
        """Information times Jacobian ``(batch, factors, 3, 6)``, float64."""
        jacobian, information = self.jacobian.double(), self.information.double()
        if information.dim() == jacobian.dim():
            return information @ jacobian
        return jacobian * information.unsqueeze(-1)


def step_information(step_std: Tensor) -> Tensor:
    """Information ``(batch, n, 3)`` of steps with standard deviations of this shape."""
    return step_std.square().reciprocal()


def chain_nodes(count: int) -> Tensor:
    """Nodes ``(1, count, 2)`` of the relative poses of a chain: each leads to the next node."""
    index = torch.arange(count)
    return torch.stack((index, index + 1), dim=-1).unsqueeze(0)


def relative_factors(nodes: Tensor, poses: Tensor, residual: Tensor, information: Tensor) -> Factors:
    """Measurements of one pose from another, as those of a chain or of loops.

    Args:
        nodes: the pose measured from, and the pose measured ``(batch, factors, 2)``.
        poses: global poses of all nodes ``(batch, nodes, 3)``.
        residual: measured less predicted pose of the second, seen from the first ``(batch, factors, 3)``.
        information: ``(batch, factors, 3)`` or ``(batch, factors, 3, 3)``, along the axes of the first.
    """
    nodes = nodes.expand(poses.shape[0], -1, -1)
    start, end = (pick(poses, nodes[..., k]) for k in (0, 1))
    heading = start[..., 2]
    offset = se2.rotate(-heading, end[..., :2] - start[..., :2])
    cos, sin, zero, one = torch.cos(heading), torch.sin(heading), torch.zeros_like(heading), torch.ones_like(heading)
    rows = (
        torch.stack((-cos, -sin, offset[..., 1], cos, sin, zero), dim=-1),
        torch.stack((sin, -cos, -offset[..., 0], -sin, cos, zero), dim=-1),
        torch.stack((zero, zero, -one, zero, zero, one), dim=-1),
    )
    return Factors(nodes, torch.stack(rows, dim=-2), residual, information)


def normal_blocks(factors: Sequence[Factors]) -> tuple[Tensor, Tensor, Tensor]:
    """The part of each factor in the normal equations.

    Returns:
        Nodes ``(batch, n, 2)``, and of these two a matrix ``(batch, n, 6, 6)`` and a right hand side ``(batch, n, 6)``,
        both float64.
    """
    nodes = torch.cat([f.nodes for f in factors], dim=1)
    jacobian = torch.cat([f.jacobian for f in factors], dim=1).double()
    residual = torch.cat([f.residual for f in factors], dim=1).double()
    weighted = torch.cat([f.weighted_jacobian for f in factors], dim=1)
    return nodes, weighted.mT @ jacobian, (weighted.mT @ residual.unsqueeze(-1)).squeeze(-1)


def gauss_newton_step(factors: list[Factors], count: int) -> Tensor:
    """Changes ``(batch, count, 3)``, float64, of the poses of nodes 0 to ``count - 1``; node 0 stays where it is."""
    nodes, hessian, gradient = normal_blocks(factors)
    step: Tensor = _Solve.apply(hessian, gradient, nodes, count)  # type: ignore[no-untyped-call]
    return step


@torch.no_grad()
def node_covariance(factors: list[Factors], count: int, node: int) -> Tensor:
    """Covariance ``(batch, 3, 3)`` of one node's pose in the map, float64, given all factors and the origin."""
    nodes, hessian, _ = normal_blocks(factors)
    factor = _factorised(hessian, nodes, count)
    right = torch.zeros(factor.shape[0], factor.shape[1], 3, dtype=factor.dtype, device=factor.device)
    first = 3 * (node - 1)
    right[:, first : first + 3] = torch.eye(3, dtype=factor.dtype, device=factor.device)
    covariance = torch.cholesky_solve(right, factor)[:, first : first + 3]
    return 0.5 * (covariance + covariance.mT)


class _Solve(torch.autograd.Function):
    """Sums the factors' normal equations and solves them; its backward pass sees vectors only, no matrix."""

    @staticmethod
    def forward(ctx: Any, hessian: Tensor, gradient: Tensor, nodes: Tensor, count: int) -> Tensor:
        right = _summed(gradient.unflatten(-1, (2, 3)), nodes, count)
        factor = _factorised(hessian, nodes, count)
        step = _solved(factor, right)
        ctx.save_for_backward(factor, step, nodes)
        return step

    @staticmethod
    def backward(ctx: Any, step_gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:
        factor, step, nodes = ctx.saved_tensors
        adjoint = _solved(factor, step_gradient)
        by_factor = [pick(v, nodes.flatten(1)).unflatten(1, nodes.shape[1:]).flatten(-2) for v in (adjoint, step)]
        return -by_factor[0].unsqueeze(-1) * by_factor[1].unsqueeze(-2), by_factor[0], None, None


def _summed(parts: Tensor, nodes: Tensor, count: int) -> Tensor:
    """Sum the parts ``(batch, factors, 2, 3)`` at their nodes ``(batch, count, 3)``."""
    index = nodes.flatten(1).unsqueeze(-1).expand(-1, -1, 3)
    return parts.new_zeros(parts.shape[0], count, 3).scatter_add(1, index, parts.flatten(1, 2))


def _factorised(hessian: Tensor, nodes: Tensor, count: int) -> Tensor:
    """Cholesky factor ``(batch, 3 (count - 1), 3 (count - 1))`` of the factors' ``(batch, factors, 6, 6)`` summed."""
    batch, size = hessian.shape[0], 3 * count
    rows = (3 * nodes.unsqueeze(-1) + torch.arange(3, device=nodes.device)).flatten(-2)
    flat = rows.unsqueeze(-1) * size + rows.unsqueeze(-2)
    matrix = hessian.new_zeros(batch, size * size).scatter_add(1, flat.flatten(1), hessian.flatten(1))
    matrix = matrix.unflatten(1, (size, size))[:, 3:, 3:]
    matrix.diagonal(dim1=-2, dim2=-1).mul_(1.0 + RELATIVE_JITTER)
    return torch.linalg.cholesky(matrix)


def _solved(factor: Tensor, right: Tensor) -> Tensor:
    """Solve for all nodes but the first, which stays zero."""
    solution = torch.cholesky_solve(right[:, 1:].flatten(1).unsqueeze(-1), factor).squeeze(-1).unflatten(1, (-1, 3))
    return torch.cat((torch.zeros_like(right[:, :1]), solution), dim=1)


def pick(values: Tensor, index: Tensor) -> Tensor:
    """Rows ``(batch, n, ...)`` of values ``(batch, rows, channels)`` at ``(batch, n)``."""
    return values.gather(1, index.unsqueeze(-1).expand(-1, -1, values.shape[-1]))
