"""The meta-poses that the optimizer takes, changes in each iteration, and returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.se2 import Values, library
from ngo_estimator.graph.gauss_newton import chain_nodes, node_covariance, relative_factors, step_information
from ngo_estimator.loops.loop_closure import Loops

if TYPE_CHECKING:
    from ngo_estimator.graph.block_cholesky import Array
    from ngo_estimator.graph.normal_equations import NormalEquations


@dataclass(frozen=True)
class MetaSteps:
    """Relative meta-poses of the local odometry, smoothed if the optimizer has a smoother.

    ``relative`` ``(batch, poses, 3)`` (m, m, rad) and ``std``, their standard deviations along the axes of the pose
    before. The last ``blocks`` of them are blocks of steps, with ``features`` ``(batch, blocks, width)`` if the
    optimizer has a network. The poses in front of these are key frames: each leads to the next one, over any number of
    steps. ``in_blocks`` ``(batch, blocks, block, 3)`` are the poses within blocks; overlaps need them.
    ``fixed`` ``(batch, blocks)``: blocks that networks leave as they are.
    """

    relative: Tensor
    std: Tensor
    features: Tensor | None
    blocks: int
    in_blocks: Tensor | None = None
    fixed: Tensor | None = None

    @property
    def key_frames(self) -> int:
        """Relative meta-poses in front of the blocks."""
        return self.relative.shape[1] - self.blocks

    def without_fixed(self, before: Tensor, after: Tensor, stiffness: Tensor) -> tuple[Tensor, Tensor]:
        """Relative poses ``(batch, poses, 3)`` and stiffness after both phases; those of fixed blocks as ``before``."""
        if self.fixed is None:
            return after, stiffness
        which = self.fixed.unsqueeze(-1)
        whole = nn.functional.pad(which, (0, 0, self.key_frames, 0))
        return torch.where(whole, before, after), torch.where(which, torch.zeros_like(stiffness), stiffness)


@dataclass(frozen=True)
class GraphState:
    """The meta-poses between two iterations.

    ``adjusted`` ``(batch, poses, 3)`` are the relative poses of the odometry with all adjustments so far, the paper's
    Delta P. ``deviation`` ``(batch, poses, 3)``, float64, is what closing loops has added to them. ``step_std``
    ``(batch, poses, 3)`` are the deviations with which the odometry is believed, ``features`` ``(batch, blocks,
    width)`` the paper's F (width 0 without a network).
    """

    adjusted: Tensor
    deviation: Tensor
    step_std: Tensor
    features: Tensor

    @classmethod
    def initial(cls, steps: MetaSteps) -> GraphState:
        """The state before the first iteration."""
        batch, poses, _ = steps.relative.shape
        features = steps.relative.new_zeros(batch, poses, 0) if steps.features is None else steps.features
        # Sums over hundreds of poses need more digits than float32 has.
        return cls(steps.relative, torch.zeros_like(steps.relative, dtype=torch.float64), steps.std, features)

    @property
    def relative(self) -> Tensor:
        """Corrected relative poses ``(batch, poses, 3)``."""
        return self.adjusted + self.deviation

    @cached_property
    def poses(self) -> Tensor:
        """Corrected global poses with the origin in front ``(batch, poses + 1, 3)``: the paper's P = r2g(Delta P)."""
        return with_origin(se2.r2g(self.relative))


class Correction(NamedTuple):
    """What the network gives in one iteration: adjustments ``(batch, blocks, 3)``, and the stiffness of this shape."""

    adjustment: Tensor
    stiffness: Tensor


@dataclass(frozen=True)
class OptimizedMetaPoses:
    """The optimizer's result for a batch of meta-steps.

    ``meta_relative``: one ``(batch, poses, 3)`` for each iteration, first to last. ``step_std`` ``(batch, poses, 3)``:
    the deviations with which the odometry is believed. ``corrections``: what the network gave in each iteration.
    ``left``: iterations to come.

    After the last iteration of an optimizer with loops, ``loops`` are these, those found under corrected poses
    included, with ``loop_weights`` ``(batch, loops)`` from zero to one, and ``loop_information`` ``(batch, loops, 3)``
    (1/m^2, 1/m^2, 1/rad^2) along the axes of the map, the same along x and y. ``equations`` are those of the last
    Gauss-Newton step, where no gradient was asked for.
    """

    meta_relative: list[Tensor]
    step_std: Tensor
    corrections: list[Correction] = field(default_factory=list)
    left: int = 0
    loops: Loops | None = None
    loop_weights: Tensor | None = None
    loop_information: Tensor | None = None
    equations: NormalEquations | None = None

    def end_covariance(self) -> Tensor:
        """Covariance ``(batch, 3, 3)`` of the last meta-pose in the map (x, y, yaw), float64."""
        if self.equations is not None:
            # They are linearised before the last step. That step was small, and all else is the same.
            return torch.from_numpy(self.equations.covariance([self.step_std.shape[1]])).unsqueeze(0)
        poses = with_origin(se2.r2g(self.meta_relative[-1].double()))
        measured = [(chain_nodes(poses.shape[1] - 1).to(poses.device), step_information(self.step_std.double()))]
        if self.loops is not None and self.loop_information is not None:
            measured.append((self.loops.nodes, self.loop_information.double()))
        factors = [
            relative_factors(nodes, poses, torch.zeros_like(information), information)
            for nodes, information in measured
        ]
        return node_covariance(factors, poses.shape[1], poses.shape[1] - 1)


class Solution(NamedTuple):
    """Where the optimisation of one trajectory ended, in arrays.

    ``poses`` ``(poses + 1, 3)``, the origin in front; ``step_std`` ``(poses, 3)``; ``weights`` ``(loops,)`` and
    ``information`` ``(loops, 3)``, none without loops; ``end`` ``(3, 3)`` is the covariance of the last pose.
    """

    poses: Array
    step_std: Array
    weights: Array
    information: Array
    end: Array

    @classmethod
    def of(cls, result: OptimizedMetaPoses) -> Solution:
        """The same of the only trajectory of a batch."""
        beliefs = result.loop_weights, result.loop_information
        weights, information = (torch.zeros(1, 0) if belief is None else belief for belief in beliefs)
        poses = with_origin(se2.r2g(result.meta_relative[-1].double()))
        of_batch = poses, result.step_std, weights, information, result.end_covariance()
        return cls(*(tensor[0].double().numpy() for tensor in of_batch))


@dataclass(frozen=True)
class OptimizedTrajectory(OptimizedMetaPoses):
    """The same with ``poses`` ``(batch, steps, 3)``: corrected global poses of all frames after the origin."""

    poses: Tensor = field(kw_only=True)


def with_origin(poses: Values) -> Values:
    """Rows ``(..., n + 1, k)``, of which the first is zero: of poses ``(..., n, k)`` those with the origin in front."""
    of = library(poses)
    padded: Values = of.concatenate((of.zeros_like(poses[..., :1, :]), poses), axis=-2)
    return padded
