"""A room of straight walls, and what a scanner sees in it: exact answers for the registration of scans."""

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.networks.place_encoder import PairHead
from tests.unit.ngo_estimator.ray_casting import cast, fan, walls
from tests.unit.ngo_estimator.samples import place_config

RAYS = 241
CONFIG = RegistrationConfig(RAYS, 300.0, 0.001)
# As a camera sees: much less than all around.
CAMERA = dataclasses.replace(CONFIG, rays=81, field_of_view_deg=106.0, odometry=False)
# An L-shaped room with a pillar: no two places in it look alike.
_ROOM = walls(
    ((0.0, 0.0), (6.0, 0.0), (6.0, 2.5), (3.0, 2.5), (3.0, 5.0), (0.0, 5.0)),
    ((1.2, 3.2), (1.5, 3.2), (1.5, 3.6), (1.2, 3.6)),
)


def ranges_at(poses: Tensor, rays: int = RAYS, field_of_view_deg: float = 300.0) -> Tensor:
    """Exact ranges ``(n, rays)``, float64, of scans taken at poses ``(n, 3)`` in the room, the leftmost ray first."""
    angles = fan(rays, field_of_view_deg)[::-1]
    return torch.from_numpy(np.stack([cast(_ROOM, pose, angles) for pose in poses.numpy()]))


def round_trip(steps: int, period: int = 64) -> Tensor:
    """Poses ``(steps + 1, 3)`` of a robot that drives round the room's corner again and again."""
    phase = 2.0 * math.pi * torch.arange(steps + 1, dtype=torch.float64) / period
    x, y = 2.0 + 1.0 * phase.sin(), 1.3 - 0.6 * phase.cos()
    return torch.stack((x, y, torch.atan2(0.6 * phase.sin(), phase.cos())), dim=-1)


def registering_pair_head() -> PairHead:
    """A pair head for place codes of 12 numbers with the ranges behind them."""
    torch.manual_seed(0)
    config = place_config("maze2d", code_size=12, embedding_size=8, pair_hidden_size=16, registration=CONFIG)
    return PairHead(config).eval().requires_grad_(False)


def drive_in_the_room(steps: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """A noisy odometry in the room, with place codes that hold the scans.

    Returns:
        Steps and logarithms of their deviations ``(steps, 3)``, place codes ``(steps, 253)``, that of the first frame
        ``(1, 253)``, and the true poses ``(steps, 3)`` after each step, seen from the first frame.
    """
    generator = torch.Generator().manual_seed(seed)
    poses = round_trip(steps)
    std = torch.tensor([0.003, 0.003, 0.002])
    relative = se2.between(poses[:-1], poses[1:]).float() + std * torch.randn(steps, 3, generator=generator)
    # Alike at places that are near each other, as learned codes are.
    places = torch.sin(poses @ torch.randn(3, 12, generator=generator, dtype=torch.float64))
    codes = torch.cat((places, ranges_at(poses)), dim=-1).float()
    return relative, std.log().expand(steps, 3).clone(), codes[1:], codes[:1], se2.between(poses[:1], poses[1:])


def seen_by_camera(poses: Tensor) -> Tensor:
    """Ranges ``(n, 81)`` of a camera at poses ``(n, 3)`` in the room."""
    return ranges_at(poses, CAMERA.rays, CAMERA.field_of_view_deg).float()


def camera_pair_head() -> PairHead:
    """A pair head for place codes of 12 numbers with a camera's ranges behind them."""
    config = registering_pair_head().config
    image = dataclasses.replace(config.image, width=CAMERA.rays)
    head = PairHead(dataclasses.replace(config, image=image, registration=CAMERA))
    return head.eval().requires_grad_(False)


def drive_with_a_camera(steps: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A noisy odometry in the room, with place codes that tell nothing but ranges.

    Returns:
        Steps and logarithms of their deviations ``(1, steps, 3)``, place codes ``(1, steps, 93)``, and the true poses
        ``(1, steps, 3)`` after each step, seen from the first frame.
    """
    poses = round_trip(steps)
    std = torch.tensor([0.004, 0.004, 0.01])
    noise = torch.randn(steps, 3, generator=torch.Generator().manual_seed(seed))
    relative = se2.between(poses[:-1], poses[1:]).float() + std * noise
    codes = torch.cat((torch.zeros(steps, 12), seen_by_camera(poses[1:])), dim=-1)
    truth = se2.between(poses[:1], poses[1:])
    return relative[None], std.log().expand(1, steps, 3).clone(), codes[None], truth[None]
