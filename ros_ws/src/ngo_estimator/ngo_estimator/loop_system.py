"""The linear system of a trajectory's loop closures, formed in time linear in the trajectory.

A loop's end moves with every meta-step on the loop. The Jacobian of all ends by all meta-steps is large, but all that a
Gauss-Newton step asks of it are sums over the meta-steps that two loops share, of terms that are polynomials in the
loops' ends: differences of prefix sums.
"""

from typing import Any

import torch
from torch import Tensor

from ngo_estimator import se2


class LoopSystem:
    """Loops linearised at the current poses: products with their Jacobian ``J``, which is never formed.

    ``J`` ``(3 loops, 3 blocks)`` is the derivative of each loop's end pose in the map by each relative meta-pose. A
    translation of a meta-step moves the end by as much, turned into the map; a turn swings the end about the pose
    behind the meta-step. Meta-steps outside a loop do not act on it.

    Args:
        start, end: first and last meta-step of each loop ``(batch, loops)``.
        poses: global meta-poses with the origin in front ``(batch, blocks + 1, 3)``.
    """

    def __init__(self, start: Tensor, end: Tensor, poses: Tensor) -> None:
        self.start, self.end = start, end
        # Sums over spans are differences of two larger ones, of which float32 would leave too few digits.
        poses = poses.double()
        self.heading, self.behind = poses[:, :-1, 2], poses[:, 1:, :2]
        self.ends = poses[..., :2].gather(1, (end + 1).unsqueeze(-1).expand(-1, -1, 2))

    def moved(self, steps: Tensor) -> Tensor:
        """``J y``: how far the ends move ``(batch, loops, 3)`` with changes ``(batch, blocks, 3)`` of the meta-steps."""
        steps = steps.double()
        turn = steps[..., 2:]
        xy = se2.rotate(self.heading, steps[..., :2]) - _left(self.behind) * turn
        sums = self._over_spans(torch.cat((xy, turn), dim=-1))
        return torch.cat((sums[..., :2] + _left(self.ends) * sums[..., 2:], sums[..., 2:]), dim=-1)

    def pulled(self, ends: Tensor) -> Tensor:
        """``J^T v`` ``(batch, blocks, 3)`` of values ``(batch, loops, 3)`` at the loops' ends."""
        ends = ends.double()
        turn = (ends[..., :2] * _left(self.ends)).sum(-1, keepdim=True) + ends[..., 2:]
        payload = torch.cat((ends[..., :2], turn), dim=-1)
        edges = payload.new_zeros(payload.shape[0], self.heading.shape[1] + 1, 3)
        edges = edges.scatter_add(1, self.start.unsqueeze(-1).expand_as(payload), payload)
        edges = edges.scatter_add(1, (self.end + 1).unsqueeze(-1).expand_as(payload), -payload)
        sums = edges.cumsum(1)[:, :-1]
        turn = sums[..., 2:] - (sums[..., :2] * _left(self.behind)).sum(-1, keepdim=True)
        return torch.cat((se2.rotate(-self.heading, sums[..., :2]), turn), dim=-1)

    def variances(self, step_variance: Tensor) -> Tensor:
        """Diagonal of ``J V J^T`` ``(batch, loops, 3)`` for variances ``(batch, blocks, 3)`` of the meta-steps."""
        xx, _, yy, one, x, y, x_x, _, y_y = self._over_spans(self._terms(step_variance)).unbind(-1)
        end_x, end_y = self.ends.unbind(-1)
        across_x = xx + end_y * (end_y * one - 2.0 * y) + y_y
        across_y = yy + end_x * (end_x * one - 2.0 * x) + x_x
        return torch.stack((across_x, across_y, one), dim=-1)

    def covariance(self, step_variance: Tensor) -> Tensor:
        """``J V J^T`` ``(batch, 3 loops, 3 loops)``; all x of the ends come first, then all y, then all headings."""
        xx, xy, yy, one, x, y, x_x, x_y, y_y = self._over_shared_spans(self._terms(step_variance)).unbind(1)
        end_x, end_y = self.ends.unbind(-1)
        row_x, row_y, column_x, column_y = end_x[:, :, None], end_y[:, :, None], end_x[:, None], end_y[:, None]
        swing_x, swing_y = y - row_y * one, row_x * one - x  # how the row's end swings with the turns that are shared
        cross = xy - x_y + row_y * x + column_x * swing_x
        top = torch.cat((xx + y_y - row_y * y - column_y * swing_x, cross, swing_x), dim=-1)
        middle = torch.cat((cross.mT, yy + x_x - row_x * x + column_x * swing_y, swing_y), dim=-1)
        bottom = torch.cat((swing_x.mT, swing_y.mT, one), dim=-1)
        return torch.cat((top, middle, bottom), dim=-2)

    def _terms(self, step_variance: Tensor) -> Tensor:
        """What is summed over spans ``(batch, blocks, 9)``: covariances in the map, and moments of the turns."""
        along, aside, turn = step_variance.double().unbind(-1)
        cos, sin = torch.cos(self.heading), torch.sin(self.heading)
        x, y = self.behind.unbind(-1)
        return torch.stack(
            (
                cos.square() * along + sin.square() * aside,
                cos * sin * (along - aside),
                sin.square() * along + cos.square() * aside,
                turn,
                turn * x,
                turn * y,
                turn * x.square(),
                turn * x * y,
                turn * y.square(),
            ),
            dim=-1,
        )

    def _over_spans(self, values: Tensor) -> Tensor:
        """Sums ``(batch, loops, channels)`` over each loop of ``(batch, blocks, channels)``."""
        prefix = _prefix(values)
        return _pick(prefix, self.end + 1) - _pick(prefix, self.start)

    def _over_shared_spans(self, values: Tensor) -> Tensor:
        """Sums ``(batch, channels, loops, loops)`` over the meta-steps that two loops share."""
        prefix = _prefix(values)
        at_end, at_start = _pick(prefix, self.end + 1).mT, _pick(prefix, self.start).mT
        first_end = (self.end[:, :, None] <= self.end[:, None])[:, None]
        last_start = (self.start[:, :, None] >= self.start[:, None])[:, None]
        upper = torch.where(first_end, at_end.unsqueeze(-1), at_end.unsqueeze(-2))
        lower = torch.where(last_start, at_start.unsqueeze(-1), at_start.unsqueeze(-2))
        shared = torch.minimum(self.end[:, :, None], self.end[:, None]) >= torch.maximum(
            self.start[:, :, None], self.start[:, None]
        )
        return (upper - lower) * shared[:, None]


def gauss_newton_correction(
    system: LoopSystem, residuals: Tensor, step_std: Tensor, loop_information: Tensor, deviation: Tensor
) -> Tensor:
    """Total correction ``(batch, blocks, 3)`` of the relative meta-poses that best explains all loops at once, float64.

    Minimises ``|y / step_std|^2 + sum information * (residual + J deviation - J y)^2`` in its dual form: the linear
    system has the size of the loops, not of the trajectory, and a loop of information zero has exactly no effect.

    Args:
        residuals: ``(batch, loops, 3)`` at the poses of ``system``.
        step_std: standard deviations ``(batch, blocks, 3)`` of the relative meta-poses.
        loop_information: inverse variances ``(batch, loops, 3)``, zero or more.
        deviation: correction already applied ``(batch, blocks, 3)``.
    """
    root = _root(loop_information.double())
    # What the residuals would be without the deviation, weighted.
    target = root * (residuals + system.moved(deviation))
    weighted = _weighted(system.covariance(step_std.square()), root)
    solution = _SolvePositiveDefinite.apply(weighted, target.mT.flatten(1).unsqueeze(-1))
    return system.pulled(root * solution.reshape(root.mT.shape).mT) * step_std.double().square()


def end_covariance(
    loops: tuple[Tensor, Tensor] | None, poses: Tensor, step_std: Tensor, loop_information: Tensor | None
) -> Tensor:
    """Covariance ``(batch, 3, 3)`` of the last meta-pose (x, y, yaw in the map), float64, given odometry and loops.

    The odometry's covariance, carried to the end, less what the loops take away from it. Arguments as in
    ``LoopSystem`` and ``gauss_newton_correction``; without loops ``loops`` and ``loop_information`` are None.
    """
    batch, blocks = step_std.shape[:2]
    first = torch.zeros(batch, 1, dtype=torch.long, device=poses.device)
    start, end, information = first, first + blocks - 1, poses.new_zeros(batch, 1, 3)
    if loops is not None and loop_information is not None:
        # The whole trajectory as one more loop, the last one, of no weight.
        start, end = torch.cat((loops[0], start), dim=1), torch.cat((loops[1], end), dim=1)
        information = torch.cat((loop_information, information), dim=1)
    count = start.shape[1]
    covariance = LoopSystem(start, end, poses).covariance(step_std.square())
    last = torch.arange(count - 1, 3 * count, count, device=poses.device)
    root = _root(information.double())
    factor = torch.linalg.cholesky(_weighted(covariance, root))
    to_end = root.mT.flatten(1).unsqueeze(-1) * covariance[:, :, last]
    taken = torch.linalg.solve_triangular(factor, to_end, upper=False)
    return covariance[:, last][:, :, last] - taken.mT @ taken


def _weighted(covariance: Tensor, root: Tensor) -> Tensor:
    """``W V W + 1`` with the weights ``root`` ``(batch, loops, 3)``."""
    weight = root.mT.flatten(1)
    weighted = weight[:, :, None] * covariance * weight[:, None]
    # Loops between the same places differ by the one alone, which must not drown in the rounding of large numbers.
    trace = weighted.detach().diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    extra = 1.0 + 8.0 * torch.finfo(weighted.dtype).eps * trace
    return weighted + torch.diag_embed(extra.expand(weight.shape))


def _root(information: Tensor) -> Tensor:
    """Square root whose gradient at zero is zero, that of a loop without effect, and not infinite."""
    positive = information > 0.0
    return torch.where(positive, information, 1.0).sqrt() * positive


class _SolvePositiveDefinite(torch.autograd.Function):
    """``A^-1 b`` through one Cholesky factor, which the backward pass uses again."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, right: Tensor) -> Tensor:
        factor = torch.linalg.cholesky(matrix)
        solution = torch.cholesky_solve(right, factor)
        ctx.save_for_backward(factor, solution)
        return solution

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        factor, solution = ctx.saved_tensors
        right = torch.cholesky_solve(gradient, factor)
        return -right @ solution.mT, right


def _prefix(values: Tensor) -> Tensor:
    return torch.cat((torch.zeros_like(values[:, :1]), values.cumsum(1)), dim=1)


def _pick(values: Tensor, index: Tensor) -> Tensor:
    return values.gather(1, index.unsqueeze(-1).expand(-1, -1, values.shape[-1]))


def _left(xy: Tensor) -> Tensor:
    """Vectors ``(..., 2)`` turned a quarter to the left."""
    return torch.stack((-xy[..., 1], xy[..., 0]), dim=-1)
