"""Train the compass of the 2D world: heading and position in the maze's lattice from one frame.

    python -m training.train_compass --world maze2d

Run again, it goes on where it was stopped. The weights stay in the run's folder: only the rows of the results with the
word "compass" use them, and the estimator's package does not ship them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import torch
import tyro
from torch import Tensor

from ngo_estimator.checkpoint import save_checkpoint
from ngo_estimator.geometry.lattice import snapped
from ngo_estimator.networks.compass import COMPASS, Compass, CompassConfig
from ngo_sim.episodes import Episode
from training.common import runs
from training.common.data_module import StreamedData
from training.data import streams
from training.data.streams import ALL, Batch, Share, images_of, mirrored, simulate
from training.data.worlds import TRAIN_SEEDS, VALIDATION_SEEDS, World, world_named


@dataclass(frozen=True)
class Arguments(runs.TrainerArguments):
    """Settings of a training of the compass."""

    world: Literal["maze2d"]
    """World to train for."""
    width: int = 32
    """Channels of the first convolution."""
    epochs: int = 10
    """Passes of new data."""
    datapoints: int = 100_000
    """Frames in an epoch."""
    batch_size: int = 256
    """Frames in a step of the optimiser."""
    learning_rate: float = 2e-3
    """Highest learning rate of the one-cycle schedule."""
    validation_mazes: int = 16
    """Mazes of the validation split that each epoch is measured on."""
    workers: int = 1
    """Processes that simulate for each one that trains."""
    seed: int = 0
    """Seed of the initial weights."""
    runs: Path = runs.ROOT / "runs"
    """Folder that gets WORLD/compass/ with checkpoints, logs and the weights."""


class CompassStream(streams._Stream):
    """Batches of frames, every second one of an episode, shuffled over a group of mazes; half of them are mirrored.

    A batch holds ``images`` ``(batch, height, width, channels)`` and the ``poses`` ``(batch, 3)`` in the maze.
    """

    FRAMES = 801
    EVERY = 2

    def __init__(
        self, world: World, seeds: range, epoch: int, datapoints: int, batch_size: int, share: Share = ALL
    ) -> None:
        groups = max(1, round(datapoints * self.EVERY / (streams._GROUP * self.FRAMES)))
        super().__init__(world, seeds, epoch, groups, self.FRAMES, share)
        self.batch_size = batch_size

    @property
    def batches_a_group(self) -> int:
        return streams._GROUP * len(range(0, self.FRAMES, self.EVERY)) // self.batch_size

    def batches(self, episodes: list[Episode], rng: np.random.Generator) -> Iterator[Batch]:
        images = torch.cat([images_of(self.world, episode)[:: self.EVERY] for episode in episodes])
        poses = torch.cat([torch.from_numpy(episode.poses_xyyaw[:: self.EVERY]) for episode in episodes]).float()
        for count, chosen in enumerate(torch.from_numpy(rng.permutation(len(poses))).split(self.batch_size)):
            if count == self.batches_a_group:
                break
            batch = {"images": images[chosen], "poses": poses[chosen]}
            yield mirrored(batch) if count % 2 else batch


class CompassTraining(lightning.LightningModule):
    """The likelihood of the truth under the compass's Laplace distributions, up to the lattice's symmetries.

    The error of a reading is that of the nearest pose that agrees with it, so there is no seam at 45 degrees: the
    position counts in the frame of the predicted heading.
    """

    ERROR_WEIGHT = 2.0

    def __init__(self, arguments: Arguments, network: Compass) -> None:
        super().__init__()
        self.arguments, self.network = arguments, network
        self.validation: list[tuple[Tensor, Tensor]] = []

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Losses of a batch."""
        reading, log_scale = self.network(batch["images"])
        block_m = self.network.config.block_m
        position, heading = lattice_errors(reading, batch["poses"], block_m).unbind(1)
        likelihood = (
            position * torch.exp(-log_scale[:, 0]) + 2.0 * log_scale[:, 0]
            + heading * torch.exp(-log_scale[:, 1]) + log_scale[:, 1]
        ).mean()  # fmt: skip
        # Frames that the network holds for hopeless are to be learned, too.
        error = position.mean() / block_m + heading.mean()
        return {"loss": likelihood + self.ERROR_WEIGHT * error, "likelihood": likelihood, "error": error}

    def training_step(self, batch: Batch, _: int) -> Tensor:
        figures = self(batch)
        self.log_dict(figures, on_step=False, on_epoch=True, prog_bar=True, sync_dist=True)
        return figures["loss"]

    def validation_step(self, batch: Batch, _: int) -> None:
        reading, log_scale = self.network(batch["images"])
        self.validation.append((lattice_errors(reading, batch["poses"], self.network.config.block_m), log_scale))

    def on_validation_epoch_end(self) -> None:
        errors, log_scale = (torch.cat(parts) for parts in zip(*self.validation, strict=True))
        self.validation.clear()
        figures = {f"validation_{k}": v for k, v in reading_metrics(errors, log_scale).items()}
        self.log_dict(figures, prog_bar=True, sync_dist=True)

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.arguments.learning_rate, weight_decay=1e-4)
        return runs.one_cycle(optimizer, self.trainer)


def lattice_errors(readings: Tensor, poses: Tensor, block_m: float) -> Tensor:
    """Errors ``(..., 2)`` in m and rad of readings ``(..., 3)`` at true poses ``(..., 3)`` in the lattice."""
    error = snapped(readings, poses, block_m) - poses
    return torch.stack((torch.sqrt(error[..., :2].square().sum(-1) + 1e-12), error[..., 2].abs()), dim=-1)


def reading_metrics(errors: Tensor, log_scale: Tensor) -> dict[str, float]:
    """Median, 90 % and 99 % quantile of the errors ``(frames, 2)``, and their mean in units of what was predicted (1).

    The frames whose errors lie within the predicted median are half of them where the scales are honest.
    """
    errors, scale = errors.double(), log_scale.double().exp()
    result: dict[str, float] = {}
    # The distance of a Laplace distribution in the plane has the mean 2 and the median 1.678 scales.
    for name, unit, i, mean, median in (("m", 1.0, 0, 2.0, 1.678), ("deg", 180.0 / np.pi, 1, 1.0, np.log(2.0))):
        for label, share in (("median", 0.5), ("p90", 0.9), ("p99", 0.99)):
            result[f"{label}_{name}"] = float(errors[:, i].quantile(share)) * unit
        result[f"mean_ratio_{name}"] = float((errors[:, i] / scale[:, i]).mean()) / mean
        result[f"within_median_{name}"] = float((errors[:, i] < median * scale[:, i]).double().mean())
    return result


def validation_frames(world: World, mazes: int) -> list[Batch]:
    """Every fifth frame of an episode in each of so many mazes of the validation split."""
    frames = []
    for first in range(0, mazes, 4):  # four mazes of one size
        for episode in simulate(world, list(VALIDATION_SEEDS[first : min(first + 4, mazes)]), 1000):
            poses = torch.from_numpy(episode.poses_xyyaw[::5]).float()
            frames.append({"images": images_of(world, episode)[::5], "poses": poses})
    return frames


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics (in the first process, which does so)."""
    world = world_named(arguments.world)
    folder = arguments.runs / world.name / "compass"
    run = runs.Run(folder, "train_compass", arguments, arguments.epochs, arguments.seed, settings=world.stream_settings)
    config = CompassConfig(image=world.image, block_m=world.block_m, width=arguments.width)
    training = CompassTraining(arguments, Compass(config))
    # A stream of its own: those of the local network and the place encoder start elsewhere in the range.
    seeds = TRAIN_SEEDS[len(TRAIN_SEEDS) // 4 :]

    def stream(epoch: int, share: Share) -> CompassStream:
        return CompassStream(world, seeds, epoch, arguments.datapoints, arguments.batch_size, share)

    data = StreamedData(stream, lambda: validation_frames(world, arguments.validation_mazes), arguments.workers)
    run.fit(training, data)
    if not run.is_first:
        return {}
    network = training.cpu().network.eval()
    with torch.no_grad():
        parts = [(network(batch["images"]), batch["poses"]) for batch in data.validation]
    errors = torch.cat([lattice_errors(reading, poses, world.block_m) for (reading, _), poses in parts])
    metrics = reading_metrics(errors, torch.cat([log_scale for (_, log_scale), _ in parts]))
    details = {"training": run.finish(metrics), "metrics": {"validation": metrics}}
    save_checkpoint(folder / f"{COMPASS}.safetensors", network, COMPASS, world.name, details)
    print("validation", {name: round(value, 5) for name, value in metrics.items()})
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
