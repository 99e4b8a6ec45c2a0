"""Random observations and small configurations that the tests of this folder share."""

import torch
from torch import Tensor

from ngo_estimator.checkpoint import WORLD_IMAGES
from ngo_estimator.local_pose_network import LocalPoseConfig
from ngo_estimator.place_encoder import PlaceConfig

WORLDS = ["maze2d", "maze3d"]


def observations(world: str, count: int, seed: int = 0) -> Tensor:
    image, generator = WORLD_IMAGES[world], torch.Generator().manual_seed(seed)
    values = torch.rand(count, *image.shape, generator=generator)
    return (values * 255).to(torch.uint8) if image.dtype == "uint8" else values


def local_config(world: str, **changes: object) -> LocalPoseConfig:
    return LocalPoseConfig(**{"image": WORLD_IMAGES[world], "width": 0.1, "actions": 3, "period_s": 0.1, **changes})  # type: ignore[arg-type]


def place_config(world: str, **changes: object) -> PlaceConfig:
    return PlaceConfig(**{"image": WORLD_IMAGES[world], "width": 0.1, "offset_scale_m": 0.5, **changes})  # type: ignore[arg-type]
