"""Train DeepVO, the baseline of the results, in the mazes of the local network.

    python -m training.train_deepvo --world maze3d

DeepVO sees stretches of trajectories where the local network sees single pairs. Number of frame pairs, schedule, loss,
mirror images and calibration are the same. As in the original it does not take the actions. Run it again to continue
after a stop.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from training.baselines.deepvo import DEEPVO, DeepVO, DeepVOConfig, trajectory_steps
from training.baselines.graph_settings import fit_calibration
from training.common import records, runs
from training.common.command_line import run_command
from training.common.step_losses import step_losses, step_metrics, windows_within
from training.common.trainer_arguments import TrainerArguments
from training.common.training import Figures, OverallTraining, save_weights
from training.data import episodes
from training.data.batches import ALL, Batch, Share, mirrored, relative_poses, seen_from_first
from training.data.data_module import StreamedData
from training.data.episodes import images_of, simulate
from training.data.streams import PairStream
from training.data.worlds import OPTIMIZER_TRAIN_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS, World, world_named
from training.train_local import typical_steps

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode


@dataclass(frozen=True)
class Arguments(TrainerArguments):
    """Settings of a training of DeepVO."""

    world: Literal["maze3d"]  # World to train for.
    width: float = 0.25  # Channels of the convolutions and units of the LSTM layers, as a fraction of DeepVO's.
    epochs: int = 8  # Passes of new data.
    datapoints: int = 200_000  # Frame pairs in an epoch, of all processes.
    steps: int = 40  # Steps of a stretch.
    batch_size: int = 8  # Stretches in a step of the optimiser, in each process.
    learning_rate: float = 5e-4  # Highest learning rate of the one-cycle schedule.
    validation_mazes: int = 8  # Mazes of the validation split that each epoch is measured on.
    calibration_mazes: int = 64  # Mazes that no network has seen, on which the output is calibrated.
    workers: int = 1  # Processes that simulate for each one that trains.
    out: Path = field(default=records.ROOT / "runs", kw_only=True)  # Folder that gets WORLD/deepvo.safetensors.


class StretchStream(PairStream):
    """Batches of stretches of consecutive frames, of the mazes and frames of ``PairStream``; every second is mirrored.

    A batch holds ``images`` ``(batch, steps + 1, height, width, channels)`` and ``relative`` ``(batch, steps, 3)``.
    """

    def __init__(
        self, world: World, seeds: range, epoch: int, datapoints: int, batch_size: int, steps: int, share: Share = ALL
    ) -> None:
        if not 1 <= steps < self.FRAMES:
            raise ValueError(f"steps is {steps}; expected 1 to {self.FRAMES - 1}, the steps in a maze")
        super().__init__(world, seeds, epoch, datapoints, batch_size, share)
        self.steps, self.stretches_a_maze = steps, (self.FRAMES - 1) // steps

    @staticmethod
    def stretch_of(world: World) -> int:
        return 1  # stretches are cut by `batches`, whatever the windows

    @property
    def batches_a_group(self) -> int:
        return episodes.GROUP * self.stretches_a_maze // self.batch_size

    def batches(self, episodes: list["Episode"], rng: np.random.Generator) -> Iterator[Batch]:
        images = [images_of(self.world, episode) for episode in episodes]
        relative = [relative_poses(episode.poses_xyyaw) for episode in episodes]
        order = rng.permutation(len(episodes) * self.stretches_a_maze)
        for count in range(self.batches_a_group):
            chosen = order[count * self.batch_size : (count + 1) * self.batch_size]
            cuts = [(k // self.stretches_a_maze, k % self.stretches_a_maze * self.steps) for k in chosen.tolist()]
            batch = {
                "images": torch.stack([images[maze][first : first + self.steps + 1] for maze, first in cuts]),
                "relative": torch.stack([relative[maze][first : first + self.steps] for maze, first in cuts]),
            }
            yield mirrored(batch) if count % 2 else batch


class DeepVOTraining(OverallTraining):
    """The local network's loss, over stretches; on the validation split, errors of whole episodes."""

    def __init__(self, arguments: Arguments, network: DeepVO, error_windows: tuple[int, ...]) -> None:
        super().__init__(arguments)
        self.network, self.error_windows = network, error_windows

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        relative, _state = self.network(batch["images"])
        std = self.network.relative_std
        loss, _likelihood = step_losses(
            relative, std.log().expand_as(relative), batch["relative"], std, self.error_windows
        )
        return loss, {"pose_loss": loss}

    def estimates(self, batch: Batch) -> tuple[Tensor, ...]:
        return trajectory_steps(self.network, batch["images"]), batch["relative"]

    def overall(self, *columns: Tensor) -> Figures:
        return {f"validation_{name}": value for name, value in _metrics(*columns).items()}


def validation_episodes(world: World, mazes: int) -> list[Batch]:
    """Whole episodes of the validation split."""
    return [
        {"images": images_of(world, episode), "relative": relative_poses(episode.poses_xyyaw)}
        for episode in simulate(world, list(VALIDATION_SEEDS[:mazes]), 1000)
    ]


def _metrics(relative: Tensor, truth: Tensor) -> dict[str, float]:
    found = step_metrics(relative, torch.zeros_like(relative), truth)
    return {name: found[name] for name in ("rmse_m", "rmse_deg", "bias_forward_m", "bias_deg")}


def calibrated(network: DeepVO, world: World, seeds: list[int]) -> DeepVOConfig:
    """The configuration with the bias and gain of each component that fit whole episodes of ``seeds`` best."""
    episodes = [
        (trajectory_steps(network, images_of(world, episode)).numpy(), seen_from_first(episode.poses_xyyaw)[1:])
        for episode in simulate(world, seeds, 1000)
    ]
    relative, truth = (np.stack(part) for part in zip(*episodes, strict=True))
    fit = fit_calibration(relative, truth)
    mean, std, bias = network.config.relative_mean, network.config.relative_std, network.config.relative_bias
    # What was not learned at all may fit best mirrored; a deviation stays positive.
    gain = [max(one, 0.01) for one in fit["odometry_gain"]]
    rest = (se2.g2r(torch.from_numpy(truth)).numpy() - gain * relative).mean(axis=(0, 1))
    scaled = np.array(gain) * np.array([mean, std, bias])
    scaled[2] += rest
    mean, std, bias = ((float(x), float(y), float(yaw)) for x, y, yaw in scaled)
    return dataclasses.replace(network.config, relative_mean=mean, relative_std=std, relative_bias=bias)


def main(arguments: Arguments) -> dict[str, float]:
    """Train, calibrate, write the weights, and return the validation metrics (in the first process, which does so)."""
    world = world_named(arguments.world)
    windows = windows_within(arguments.steps, world.error_windows)
    run = runs.Run(
        arguments.runs / world.name / DEEPVO,
        "train_deepvo",
        arguments,
        arguments.epochs,
        datapoints=lambda batch: batch["relative"].shape[0] * batch["relative"].shape[1],
        settings={"error_windows": list(windows), **world.stream_settings},
    )
    some = typical_steps(world)
    config = DeepVOConfig(
        world.image,
        arguments.width,
        relative_mean=(float(some[:, 0].mean()), 0.0, 0.0),
        relative_std=(float(some[:, 0].std()), float(some[:, 1].std()), float(some[:, 2].std())),
        symmetric=world.mirrors,
    )
    training = DeepVOTraining(arguments, DeepVO(config), windows)

    def stream(epoch: int, share: Share) -> StretchStream:
        a = arguments
        return StretchStream(world, TRAIN_SEEDS, epoch, a.datapoints, a.batch_size, a.steps, share)

    data = StreamedData(stream, lambda: validation_episodes(world, arguments.validation_mazes), arguments.workers)
    run.fit(training, data)
    if not run.is_first:
        return {}
    network = training.cpu().network.eval()
    unseen = list(OPTIMIZER_TRAIN_SEEDS[-arguments.calibration_mazes :])
    final = DeepVO(calibrated(network, world, unseen)).eval()
    final.load_state_dict(network.state_dict())
    parts = [(trajectory_steps(final, batch["images"]), batch["relative"]) for batch in data.validation]
    metrics = _metrics(*(torch.cat(column) for column in zip(*parts, strict=True)))
    save_weights(arguments.out / world.name, final, DEEPVO, run.ended(metrics))
    return metrics


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
