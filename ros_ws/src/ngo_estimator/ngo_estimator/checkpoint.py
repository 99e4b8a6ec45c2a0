"""Weights on disk: a safetensors file and a JSON description beside it."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import safetensors
from safetensors.torch import load, save
from torch import nn

from ngo_common.files import read_file, write_together
from ngo_estimator.data.configuration import config_from_dict
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.networks.familiarity import Familiarity, FamiliarityConfig
from ngo_estimator.networks.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from ngo_estimator.networks.place_encoder import PairHead, PlaceConfig, PlaceEncoder
from ngo_estimator.networks.pose_aggregation import PoseAggregationConfig
from ngo_estimator.networks.step_deviation import StepDeviation, StepDeviationConfig
from ngo_estimator.optimizer.neural_graph_optimizer import NeuralGraphOptimizer, NeuralGraphOptimizerConfig

FORMAT = 1
LOCAL, PLACE, SMOOTHER, OPTIMIZER = (
    "local_pose_network",
    "place_encoder",
    "odometry_smoother",
    "neural_graph_optimizer",
)
STEP_DEVIATION = "step_deviation"
FAMILIARITY = "familiarity"
RETIRED_SETTINGS = {OPTIMIZER: {"compass": False}}
"""Settings of earlier versions, by the kind of network, with the only value that still means the same."""
WORLD_IMAGES = {
    "maze2d": ImageFormat(height=1, width=241, channels=4, dtype="float32"),
    "maze3d": ImageFormat(height=60, width=80, channels=3, dtype="uint8"),
    "doom": ImageFormat(height=60, width=80, channels=3, dtype="uint8"),
}

Network = TypeVar("Network", bound=nn.Module)


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged, or not the one that was asked for."""


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


def load_description(path: Path, kind: str, world: str | None = None) -> dict[str, Any]:
    """The JSON beside ``path``, checked to describe a network of ``kind``, trained for ``world`` if one is given."""
    beside = path.with_suffix(".json")
    try:
        description = json.loads(read_file(beside))
    except OSError as error:
        raise CheckpointError(
            f"{beside}: cannot be read ({error.strerror}); expected the description of a {kind}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{beside}: is not JSON ({error})") from error
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise CheckpointError(f"{beside}: is not a checkpoint description of format {FORMAT}")
    if description.get("network") != kind:
        raise CheckpointError(f"{beside}: describes a {description.get('network')!r}; expected a {kind!r}")
    if world is not None and description.get("world") != world:
        raise CheckpointError(f"{beside}: was trained for the world {description.get('world')!r}; expected {world!r}")
    return description


def load_network(
    path: Path, kind: str, build: Callable[[Any], Network], config: type[Any], world: str | None = None
) -> tuple[Network, dict[str, Any]]:
    """Load one network in evaluation mode, and its description.

    Raises:
        CheckpointError: naming the file, what is wrong with it and what was expected.
    """
    description = load_description(path, kind, world)
    try:
        network = build(config_from_dict(config, _without_retired(kind, description.get("config"))))
    except (ValueError, RuntimeError, TypeError) as error:  # the latter two: sizes that no memory holds
        raise CheckpointError(f"{path.with_suffix('.json')}: {' '.join(str(error).split())}") from error
    try:
        content = read_file(path)
        tensors = load(content)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror})") from error
    except safetensors.SafetensorError as error:
        raise CheckpointError(f"{path}: is damaged or no safetensors file ({error})") from error
    if hashlib.sha256(content).hexdigest() != description.get("sha256"):
        raise CheckpointError(
            f"{path}: is not the file that {path.with_suffix('.json').name} describes (sha256 differs)"
        )
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(f"{path}: does not fit its configuration ({' '.join(str(error).split())})") from error
    if broken := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise CheckpointError(f"{path}: has weights that are not finite in {', '.join(broken)}")
    return network.eval().requires_grad_(False), description


def _without_retired(kind: str, values: Any) -> Any:
    """The values of a configuration without settings that this version no longer has."""
    if not isinstance(values, dict):
        return values
    retired = RETIRED_SETTINGS.get(kind, {})
    for name, meant in retired.items():
        if (value := values.get(name, meant)) is not meant:
            raise ValueError(f"{name} is {value!r}, which this version no longer has; expected {meant!r}, or none")
    return {name: value for name, value in values.items() if name not in retired}


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


def load_step_deviation(weights: Path, world: str | None = None) -> StepDeviation:
    """The network in the folder ``weights`` that scales deviations of a lidar's steps."""
    path = weights / f"{STEP_DEVIATION}.safetensors"
    return load_network(path, STEP_DEVIATION, StepDeviation, StepDeviationConfig, world)[0]


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
