"""Store trained networks in half the space: their weights as float16.

    python -m training.halve_weights --folder ros_ws/src/ngo_estimator/weights/scan --networks local_pose_network

They compute in float32 all the same; what it costs is to be measured (`python -m training.evaluate`). An optimizer
names the place encoder that it was trained with: when that one is halved, its description follows.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from ngo_estimator.checkpoint import LOCAL, OPTIMIZER, PLACE, load_local, load_optimizer, load_place, save_checkpoint

_OWN = ("format", "network", "world", "sha256", "config")
_LOADERS = {LOCAL: load_local, PLACE: load_place}


@dataclass(frozen=True)
class Arguments:
    """Which weights are halved."""

    folder: Path
    """Folder of one world's weights, which are replaced."""
    networks: tuple[Literal["local_pose_network", "place_encoder"], ...] = ("local_pose_network", "place_encoder")
    """Networks to halve."""


def main(arguments: Arguments) -> None:
    """Write the networks anew, and what refers to them."""
    for kind in arguments.networks:
        network, description = _LOADERS[kind](arguments.folder)
        details = {key: value for key, value in description.items() if key not in _OWN}
        path = arguments.folder / f"{kind}.safetensors"
        before = path.stat().st_size
        save_checkpoint(path, network, kind, description["world"], {**details, "stored_as": "float16"}, half=True)
        print(f"{path}: {before / 1e6:.2f} MB before, {path.stat().st_size / 1e6:.2f} MB now")
        if kind == PLACE and (arguments.folder / f"{OPTIMIZER}.json").exists():
            _follow(arguments.folder, description["sha256"])


def _follow(folder: Path, sha256_before: str) -> None:
    """Let the optimizer that was trained with the place encoder as it was name it as it is now."""
    optimizer, description = load_optimizer(folder)
    details = {key: value for key, value in description.items() if key not in _OWN}
    if details.get("place_encoder_sha256") == sha256_before:
        details["place_encoder_sha256"] = load_place(folder)[1]["sha256"]
        save_checkpoint(folder / f"{OPTIMIZER}.safetensors", optimizer, OPTIMIZER, description["world"], details)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
