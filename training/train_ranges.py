"""Teach a place encoder to see how far walls are, in levels of any height, beside the codes that it has.

    python -m training.train_ranges --from-weights ros_ws/src/ngo_estimator/weights/maze3d

What is learned is a head on the encoder's early features, which stay as they are: codes, embeddings and familiarity do
not change. It begins with the head of another encoder. True ranges are those of walls at the height of the eye, in
drives through training maps, levels of rooms and mazes. The place encoder of ``doom`` is written anew.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.optim.lr_scheduler import OneCycleLR

from ngo_estimator.checkpoint import PLACE, PlaceNetworks, load_place
from ngo_estimator.networks.place_encoder import SeenRanges
from training.common import records
from training.common.command_line import run_command
from training.common.training import descend, save_weights
from training.data.doom_drives import doom_episodes
from training.data.worlds import OPTIMIZER_TRAIN_SEEDS, VALIDATION_SEEDS

_FIRST_SEED = 300  # Of the optimizer's: the memory and the judge of loops learn from those before.
_LEAST_SURE = 0.6
"""Share of sure ranges below which a picture has none: mazes have 93 %, maps that nobody trained on 26 %."""
_SMALLEST_M, _LARGEST_M = 0.05, 140.0
_BRIGHTNESS = 0.15
_WEIGHT_DECAY = 1e-2
"""Of little variety heads learn the maps by heart: with a tenth of it, ranges of other maps were 21.4 % off, not 20."""

Frames = tuple[Tensor, Tensor]  # Images ``(n, height, width, channels)``, and the ranges of each ``(n, rays)`` (m).


@dataclass(frozen=True)
class Arguments:
    """Settings of a training of ranges."""

    from_weights: Path = records.WEIGHTS / "maze3d"  # Folder with a place encoder that sees ranges.
    drives: int = 400  # Drives to learn from, half of them on training maps.
    frames: int = 1000  # Frames of a drive.
    every: int = 5  # One frame of so many is learned from.
    steps: int = 4200  # Steps of the optimiser.
    batch_size: int = 128  # Frames in a step.
    learning_rate: float = 1.5e-3  # Highest learning rate; it falls to zero.
    seed: int = 0  # Seed of the order of the data.
    weights: Path = records.WEIGHTS  # Folder with doom/place_encoder.safetensors, which is written anew.


class Watch:
    """Keeps one of ``every`` frames with the ranges along ``angles_rad``."""

    def __init__(self, angles_rad: np.ndarray, every: int) -> None:
        self._angles, self._every, self._count = angles_rad, every, 0
        self._images: list[np.ndarray] = []
        self._ranges: list[np.ndarray] = []

    def __call__(self, world: Any, observation: np.ndarray) -> None:
        if self._count % self._every == 0:
            self._images.append(observation)
            self._ranges.append(world.wall_ranges(self._angles))
        self._count += 1

    def frames(self) -> Frames:
        """All that was kept."""
        return torch.from_numpy(np.stack(self._images)), torch.from_numpy(np.stack(self._ranges))


def driven(seeds: range, arguments: Arguments, networks: PlaceNetworks) -> Frames:
    """Frames of the drives of ``seeds``."""
    assert networks.config.registration is not None
    watch = Watch(networks.config.registration.angles_rad.double().numpy(), arguments.every)
    for seed in seeds:
        for _ in doom_episodes([seed], arguments.frames, watch):
            pass
    return watch.frames()


def with_ranges(networks: PlaceNetworks, seeing: PlaceNetworks) -> PlaceNetworks:
    """The networks with the ranges of others, of early features that need not be theirs; raises ``RunError``."""
    if not seeing.config.sees_ranges or seeing.config.width != networks.config.width:
        raise records.RunError(
            f"the encoder to begin with has width {seeing.config.width} and sees ranges: {seeing.config.sees_ranges}; "
            f"expected width {networks.config.width}, and ranges"
        )
    config = dataclasses.replace(networks.config, registration=seeing.config.registration, least_sure=_LEAST_SURE)
    result = PlaceNetworks(config)
    head = {f"encoder.ranges.{k}": v for k, v in seeing.encoder.ranges.state_dict().items()}
    result.load_state_dict({**networks.state_dict(), **head})
    return result


def loss_of(seen: SeenRanges, ranges: Tensor) -> tuple[Tensor, Tensor]:
    """Negative logarithm of the likelihood, and the errors of the logarithm of ranges, both ``(n, rays)``."""
    error = (seen.log_range - ranges.clamp(_SMALLEST_M, _LARGEST_M).log()).abs()
    return error * torch.exp(-seen.log_scale) + seen.log_scale, error


def learn(networks: PlaceNetworks, frames: Frames, arguments: Arguments) -> None:
    """Train the head that sees ranges, and it alone."""
    torch.manual_seed(arguments.seed)
    images, ranges = frames
    encoder = networks.encoder.requires_grad_(False)
    head = encoder.ranges.requires_grad_(True).train()

    def loss(step: int) -> Tensor:
        chosen = torch.randint(len(images), (arguments.batch_size,))
        image, target = images[chosen], ranges[chosen]
        if step % 2:
            image, target = image.flip(-2), target.flip(-1)
        gain = 1.0 + _BRIGHTNESS * (2.0 * torch.rand(len(image), 1, 1, 1) - 1.0)
        return loss_of(head(encoder.early((image * gain).clamp(0, 255).to(torch.uint8))), target)[0].mean()

    rate, steps = arguments.learning_rate, arguments.steps
    schedule = partial(OneCycleLR, max_lr=rate, total_steps=steps, pct_start=0.05, cycle_momentum=False)
    descend(head.parameters(), loss, steps, schedule, largest_norm=1.0, lr=rate, weight_decay=_WEIGHT_DECAY)
    networks.eval().requires_grad_(False)


@torch.no_grad()
def measured(networks: PlaceNetworks, frames: Frames) -> dict[str, float]:
    """How well ranges are seen: the median error, the likelihood, and the share of ranges that are sure."""
    likelihood, error, known = [], [], []
    for images, ranges in zip(frames[0].split(256), frames[1].split(256), strict=True):
        seen = networks.encoder.ranges(networks.encoder.early(images))
        one = loss_of(seen, ranges)
        likelihood.append(one[0])
        error.append(one[1])
        known.append(seen.ranges > 0.0)
    return {
        "median_range_percent": float(100.0 * torch.cat(error).median()),
        "range_loss": float(torch.cat(likelihood).mean()),
        "sure_ranges": float(torch.cat(known).double().mean()),
    }


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the metrics on drives that were held out."""
    folder = arguments.weights / "doom"
    networks, described = load_place(folder, "doom")
    seeing, began = load_place(arguments.from_weights)
    networks = with_ranges(networks, seeing)
    first = OPTIMIZER_TRAIN_SEEDS[_FIRST_SEED]
    learn(networks, driven(range(first, first + arguments.drives), arguments, networks), arguments)
    metrics = measured(networks, driven(VALIDATION_SEEDS[:16], arguments, networks))
    about = {**records.record("train_ranges", arguments), "began_with_sha256": began["sha256"], "metrics": metrics}
    save_weights(folder, networks, PLACE, {**records.kept_details(described), "ranges": about})
    print("validation", {name: round(value, 4) for name, value in metrics.items()})
    return metrics


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
