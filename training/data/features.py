"""Features of whole trajectories, by the local network and the place encoder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.checkpoint import PlaceNetworks, load_local, load_place
from ngo_estimator.networks.local_pose_network import LocalPoseNetwork
from training.data.batches import Batch, action_histories, seen_from_first
from training.data.episodes import images_of
from training.data.worlds import World

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

OPTIMIZER_INPUTS = ("relative", "log_std", "motion", "codes", "origin_code")
"""The features that ``optimize_offline`` takes, in its order."""

_CHUNK = 64  # steps at once: their activations stay in a CPU's cache (a fifth faster than 256)


class Networks(NamedTuple):
    """The networks that turn frames into features."""

    local: LocalPoseNetwork
    place: PlaceNetworks


def features_of(
    world: World, episode: Episode, weights: Path, networks: tuple[LocalPoseNetwork, PlaceNetworks] | None = None
) -> dict[str, np.ndarray]:
    """Features of the ``frames - 1`` steps of an episode, and the true poses after each, as of ``step_features``."""
    local, place = networks or (load_local(weights, world.name)[0], load_place(weights, world.name)[0])
    images = images_of(world, episode)
    actions = {"action": action_histories(episode.actions)} if world.actions else {}
    return step_features(lambda index: images[index], actions, episode.poses_xyyaw, Networks(local, place))


@torch.inference_mode()
def step_features(
    frames: Callable[[slice], Tensor], controls: Batch, poses_xyyaw: np.ndarray, networks: Networks
) -> dict[str, np.ndarray]:
    """Features of ``steps`` steps, the place code of the first frame, and the true poses after each step, seen from it.

    Args:
        frames: gives images of a range of frames ``(n, height, width, channels)``.
        controls: ``action`` ``(steps, n)``, the latest ones of each step, and ``twist`` ``(steps, 3)``, where the
            networks take them.
        poses_xyyaw: ``(steps + 1, 3)``.
    """
    parts: list[tuple[Tensor, ...]] = []
    for chunk in torch.arange(len(poses_xyyaw) - 1).split(_CHUNK):
        images = frames(slice(int(chunk[0]), int(chunk[-1]) + 2))
        side = {name: value[chunk] for name, value in controls.items()}
        relative, log_std, motion = networks.local(images[:-1], images[1:], side.get("action"), side.get("twist"))
        parts.append((relative, log_std, motion, networks.place.encoder(images[1:])))
    relative, log_std, motion, codes = (torch.cat(column) for column in zip(*parts, strict=True))
    relative, log_std = networks.local.remembered(relative, log_std, motion)
    return {
        "relative": relative.numpy(),
        "log_std": log_std.numpy(),
        "motion": motion.numpy().astype(np.float16),
        "codes": codes.numpy().astype(np.float16),
        "origin_code": networks.place.encoder(frames(slice(0, 1))).numpy().astype(np.float16),
        "truth": seen_from_first(poses_xyyaw)[1:],
    }
