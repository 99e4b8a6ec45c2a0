"""Weights on disk: a safetensors file and a JSON description beside it."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors.torch import save
from torch import nn

from ngo_common.files import write_together
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.weights_file import FORMAT, CheckpointError, load_description, read_weights
from ngo_estimator.networks.familiarity import Familiarity, FamiliarityConfig
from ngo_estimator.networks.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from ngo_estimator.networks.place_encoder import PairHead, PlaceConfig, PlaceEncoder
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer, NeuralGraphOptimizerConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig

LOCAL, PLACE, SMOOTHER, OPTIMIZER = (
    "local_pose_network",
    "place_encoder",
    "odometry_smoother",
    "neural_graph_optimizer",
)
FAMILIARITY = "familiarity"
WORLD_IMAGES = {
    "maze2d": ImageFormat(height=1, width=241, channels=4, dtype="float32"),
    "maze3d": ImageFormat(height=60, width=80, channels=3, dtype="uint8"),
    "doom": ImageFormat(height=60, width=80, channels=3, dtype="uint8"),
}

Network = TypeVar("Network", bound=nn.Module)


class PlaceNetworks(nn.Module):
    """The place encoder and its pair head, which are trained, stored and loaded together."""

    def __init__(self, config: PlaceConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = PlaceEncoder(config)
        self.pair_head = PairHead(config)

    def without_ranges(self) -> "PlaceNetworks":
        """The same networks, but for the ranges that they see in pictures."""
        changed = PlaceNetworks(dataclasses.replace(self.config, registration=None))
        changed.load_state_dict({k: v for k, v in self.state_dict().items() if not k.startswith("encoder.ranges.")})
        return changed


def save_checkpoint(
    path: Path, network: nn.Module, kind: str, world: str, details: dict[str, Any], half: bool = False
) -> None:
    """Write ``path`` (``.safetensors``) and its ``.json``, each at once or not at all.

    ``details`` goes into the JSON beside the configuration: the training command, seed, revision and metrics. With
    ``half`` the weights are stored as float16; a network computes in float32 all the same.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    if half:
        tensors = {name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}
    weights = save(tensors)
    description = {
        "format": FORMAT,
        "network": kind,
        "world": world,
        "sha256": hashlib.sha256(weights).hexdigest(),
        "config": dataclasses.asdict(network.config),  # type: ignore[call-overload]
        **details,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_together({path: weights, path.with_suffix(".json"): json.dumps(description, indent=2) + "\n"})


def load_network(
    path: Path, kind: str, build: Callable[[Any], Network], config: type[Any], world: str | None = None
) -> tuple[Network, dict[str, Any]]:
    """Load one network in evaluation mode, and its description.

    Raises:
        CheckpointError: naming the file, what is wrong with it and what was expected.
    """
    settings, arrays, description = read_weights(path, kind, config, world)
    try:
        network = build(settings)
    except (ValueError, RuntimeError, TypeError) as error:  # the latter two: sizes that no memory holds
        raise CheckpointError(f"{path.with_suffix('.json')}: {' '.join(str(error).split())}") from error
    try:
        network.load_state_dict({name: torch.tensor(array) for name, array in arrays.items()})
    except RuntimeError as error:
        raise CheckpointError(f"{path}: does not fit its configuration ({' '.join(str(error).split())})") from error
    return network.eval().requires_grad_(False), description


def load_local(weights: Path, world: str | None = None) -> tuple[LocalPoseNetwork, dict[str, Any]]:
    """The local pose network in the folder ``weights``."""
    return load_network(weights / f"{LOCAL}.safetensors", LOCAL, LocalPoseNetwork, LocalPoseConfig, world)


def load_place(weights: Path, world: str | None = None) -> tuple[PlaceNetworks, dict[str, Any]]:
    """The place encoder and pair head in the folder ``weights``."""
    return load_network(weights / f"{PLACE}.safetensors", PLACE, PlaceNetworks, PlaceConfig, world)


def load_smoother(weights: Path, world: str | None = None) -> tuple[OdometrySmoother, dict[str, Any]]:
    """The odometry smoother in the folder ``weights``, of the local network beside it.

    Optimizers are trained with a copy of it. Raises ``CheckpointError`` also if it was trained on the odometry of
    another local network.
    """
    path = weights / f"{SMOOTHER}.safetensors"
    smoother, description = load_network(path, SMOOTHER, OdometrySmoother, SmootherConfig, world)
    local = load_description(weights / f"{LOCAL}.safetensors", LOCAL, world)
    if description.get("local_pose_network_sha256") != local.get("sha256"):
        raise CheckpointError(f"{path}: was trained on another local network than the one beside it; train it again")
    return smoother, description


def load_optimizer(weights: Path, world: str | None = None) -> tuple[NeuralGraphOptimizer, dict[str, Any]]:
    """The Neural Graph Optimizer in the folder ``weights``."""
    path = weights / f"{OPTIMIZER}.safetensors"
    return load_network(path, OPTIMIZER, NeuralGraphOptimizer, NeuralGraphOptimizerConfig, world)


def load_familiarity(weights: Path, world: str | None = None) -> Familiarity | None:
    """What tells unlike input, from the folder ``weights``; None where it was not fitted.

    Raises ``CheckpointError`` also if it was fitted to other networks than those beside it.
    """
    path = weights / f"{FAMILIARITY}.safetensors"
    if not path.exists():
        return None
    familiarity, description = load_network(path, FAMILIARITY, Familiarity, FamiliarityConfig, world)
    for kind in (LOCAL, PLACE):
        if description.get(f"{kind}_sha256") != load_description(weights / f"{kind}.safetensors", kind)["sha256"]:
            raise CheckpointError(f"{path}: was fitted to another {kind} than the one beside it; fit it again")
    return familiarity


def write_untrained(weights: Path, world: str, image: ImageFormat | None = None) -> None:
    """Write freshly initialised networks for ``world`` into a folder: what training starts from, and tests use.

    ``image`` is what they take, by default that of a shipped world.
    """
    if image is None:
        if world not in WORLD_IMAGES:
            raise ValueError(f"world is {world!r}; expected one of {sorted(WORLD_IMAGES)}, or an image format")
        image = WORLD_IMAGES[world]
    std = (0.1, 0.02, 0.05)
    details = {"training": "none: freshly initialised"}
    local = LocalPoseNetwork(
        LocalPoseConfig(
            image=image,
            width=0.125,
            actions=3 if world in WORLD_IMAGES else 0,
            period_s=2 / 35 if world in ("maze3d", "doom") else 0.1,
            relative_std=std,
        )
    )
    place = PlaceNetworks(PlaceConfig(image=image, width=0.125, offset_scale_m=0.5))
    aggregation = PoseAggregationConfig(motion_feature_size=local.config.feature_size, relative_std=std)
    optimizer = NeuralGraphOptimizer(NeuralGraphOptimizerConfig(aggregation=aggregation))
    for kind, network in ((LOCAL, local), (PLACE, place), (OPTIMIZER, optimizer)):
        save_checkpoint(weights / f"{kind}.safetensors", network, kind, world, details)
