"""How familiar an observation is: numbers fitted to frames that the networks did not learn from.

Not in the paper. Networks are sure of frames that they know nothing of. Four distances tell such frames: how a picture
looks (Mahalanobis distance of statistics of the place encoder's early features), the motion feature (likewise), how far
the motion is from the one that actions or wheels tell, and how much changed since the frame before.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.networks.place_encoder import PlaceEncoder

DISTANCES = ("look", "motion", "told", "change")
"""The distances of an observation, in the order of ``Familiarity.distances``."""

NO_LIMIT = 1e9  # Limit of a distance that tells nothing.

HISTORY = 12  # Latest actions from which the motion is told.

_COLUMNS = 4  # of the picture, each with statistics of its own
_GAIN = 5.0  # of the early features before their logarithm
_RIDGE = 0.01  # share of the mean variance that is added along each axis
_LEAST_CHANGE = 1e-4  # in units of the usual change: as good as none


def look_size(encoder: PlaceEncoder) -> int:
    """Numbers of ``look``."""
    return 2 * _COLUMNS * encoder.convolutions.early_channels


@dataclass(frozen=True)
class FamiliarityConfig:
    """What was fitted to held-out drives, and how large its vectors are.

    ``limits``: the 99.9th percentile of each of ``DISTANCES``, averaged over ``memory`` frames. ``actions``, ``twist``:
    what the networks are told of a step. ``told_std`` (m, m, rad): deviation of the motion that this alone tells, so
    that its errors over 64 steps are honest. ``told_share``: weight of that motion where an observation is unfamiliar.
    ``disagreement`` times what the two motions differ is the error that all unfamiliar steps of a stretch share.
    ``usual_change``: median change between frames.
    """

    look_size: int
    motion_size: int
    actions: int = 0
    twist: bool = False
    limits: tuple[float, ...] = (NO_LIMIT,) * len(DISTANCES)
    told_std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    told_share: tuple[float, float, float] = (0.0, 0.0, 0.0)
    disagreement: float = 1.0
    usual_change: float = 1.0
    memory: int = 16

    def __post_init__(self) -> None:
        check(self, "look_size motion_size memory", "at least 1", lambda x: x >= 1)
        check(self, "actions", "at least 0", lambda x: x >= 0)
        check_positive(self, "limits told_std disagreement usual_change")
        check(self, "told_share", "shares of 0 to 1", lambda x: 0.0 <= x <= 1.0)
        if len(self.limits) != len(DISTANCES):
            raise ValueError(f"limits is {self.limits}; expected {len(DISTANCES)} numbers")

    @property
    def told_size(self) -> int:
        """Numbers that are told of a step, with a constant one at the end."""
        return self.actions * HISTORY + 3 * self.twist + 1

    @property
    def is_told(self) -> bool:
        """Whether the networks are told anything of a step."""
        return self.told_size > 1


class Familiarity(nn.Module):
    """The fitted numbers; nothing here is trained by gradient."""

    def __init__(self, config: FamiliarityConfig) -> None:
        super().__init__()
        self.config = config
        for name, size in (("look", config.look_size), ("motion", config.motion_size)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_whitener", torch.eye(size))
        self.register_buffer("told", torch.zeros(config.told_size, 3))
        self.look_mean: Tensor
        self.look_whitener: Tensor
        self.motion_mean: Tensor
        self.motion_whitener: Tensor
        self.told: Tensor

    def fit(self, looks: Tensor, motions: Tensor, told: Tensor, relative: Tensor) -> None:
        """Fit the means, the whiteners and the motion that is told, to ``n`` steps.

        Args:
            looks: ``(n, look_size)`` of ``look``; motions: motion features ``(n, motion_size)``.
            told: ``(n, told_size)`` of ``told_vector``; relative: true steps ``(n, 3)``.
        """
        for name, values in (("look", looks.double()), ("motion", motions.double())):
            mean, variance = values.mean(0), torch.cov(values.T)
            eigenvalues, vectors = torch.linalg.eigh(variance)
            scale = (eigenvalues + _RIDGE * eigenvalues.mean() + 1e-12).rsqrt()
            getattr(self, f"{name}_mean").copy_(mean)
            getattr(self, f"{name}_whitener").copy_(vectors * scale)
        told = told.double()
        normal = told.T @ told + 1e-6 * len(told) * torch.eye(told.shape[1], dtype=told.dtype)
        self.told.copy_(torch.linalg.solve(normal, told.T @ relative.double()))

    def told_motion(self, told: Tensor) -> Tensor:
        """The motion ``(n, 3)`` that actions or wheels tell ``(n, told_size)``."""
        return told @ self.told

    def distances(self, looks: Tensor, motions: Tensor, told: Tensor, relative: Tensor, change: Tensor) -> Tensor:
        """The distances ``(n, 4)`` of observations, in the order of ``DISTANCES``; arguments as of ``fit``.

        Args:
            relative: as the network estimates it; change: mean absolute change since the frame before ``(n,)``.
        """
        look = ((looks - self.look_mean) @ self.look_whitener).square().mean(-1).sqrt()
        motion = ((motions - self.motion_mean) @ self.motion_whitener).square().mean(-1).sqrt()
        off = (relative - self.told_motion(told)) / self.told.new_tensor(self.config.told_std)
        apart = torch.log1p(off.square().mean(-1).sqrt()) * self.config.is_told
        changed = (change / self.config.usual_change).clamp(min=_LEAST_CHANGE).log().abs()
        return torch.stack((look, motion, apart, changed), dim=-1)


def look(early: Tensor) -> Tensor:
    """Statistics ``(n, look_size)`` of a place encoder's early features ``(n, channels, ...)`` of images.

    Mean and deviation of each channel in columns of the picture, on a logarithmic scale.
    """
    early = early if early.dim() == 4 else early.unsqueeze(2)  # a row has no height
    parts = [
        stat for part in early.tensor_split(_COLUMNS, dim=-1) for stat in (part.mean((-1, -2)), part.std((-1, -2)))
    ]
    return torch.asinh(_GAIN * torch.cat(parts, dim=-1)).float()


def told_vector(config: FamiliarityConfig, actions: Tensor | None, twist: Tensor | None, count: int) -> Tensor:
    """What is told of ``count`` steps ``(count, told_size)``.

    Args:
        actions: the latest actions of each step ``(count, HISTORY)``, -1 where there was none.
        twist: mean velocities ``(count, 3)``.
    """
    parts = []
    if config.actions:
        assert actions is not None
        parts.append(nn.functional.one_hot(actions[:, -HISTORY:] + 1, config.actions + 1)[..., 1:].flatten(1).float())
    if config.twist:
        assert twist is not None
        parts.append(twist.float())
    return torch.cat((*parts, torch.ones(count, 1)), dim=-1)


def change(earlier: Tensor, later: Tensor) -> Tensor:
    """Mean absolute change ``(n,)`` between observations ``(n, height, width, channels)``; what is not finite is 0."""
    difference = later.float().nan_to_num(0.0, 0.0, 0.0) - earlier.float().nan_to_num(0.0, 0.0, 0.0)
    return difference.abs().flatten(1).mean(-1)
