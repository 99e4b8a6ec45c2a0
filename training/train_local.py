"""Train the local pose network of a world on pairs of frames that worker processes simulate.

    python -m training.train_local --world maze2d

Run again, it goes on where it was stopped. It ends with the network's output calibrated on mazes that it has not seen
(one bias and scale a component, folded into its normalisation) and its weights written into the estimator's package.
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
import tyro
from torch import Tensor
from torch.nn.functional import smooth_l1_loss
from torch.utils.data import DataLoader

from ngo_estimator import se2
from ngo_estimator.checkpoint import LOCAL, save_checkpoint
from ngo_estimator.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from training import runs
from training.streams import Batch, PairStream, Share, images_of, loader, relative_poses, simulate
from training.worlds import OPTIMIZER_TRAIN_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS, World, WorldName, world_named

HEADING_WEIGHT = 3.0
LIKELIHOOD_WEIGHT = 0.1


@dataclass(frozen=True)
class Arguments(runs.TrainerArguments):
    """Settings of a training of the local pose network."""

    world: WorldName
    """World to train for."""
    width: float = 0.25
    """Channels of the convolutions, as a fraction of FlowNetS's."""
    epochs: int = 8
    """Passes of new data."""
    datapoints: int = 200_000
    """Frame pairs in an epoch, of all processes."""
    batch_size: int = 256
    """Frame pairs in a step of the optimiser, in each process."""
    learning_rate: float = 2e-3
    """Highest learning rate of the one-cycle schedule."""
    validation_mazes: int = 8
    """Mazes of the validation split that each epoch is measured on."""
    workers: int = 1
    """Processes that simulate for each one that trains."""
    seed: int = 0
    """Seed of the initial weights."""
    out: Path = runs.WEIGHTS
    """Folder that gets WORLD/local_pose_network.safetensors."""
    runs: Path = runs.ROOT / "runs"
    """Folder of checkpoints and logs."""


class LocalTraining(lightning.LightningModule):
    """The losses of single steps, ``step_losses``."""

    def __init__(self, arguments: Arguments, world: World, network: LocalPoseNetwork) -> None:
        super().__init__()
        self.arguments, self.world, self.network = arguments, world, network
        self.validation: list[tuple[Tensor, Tensor, Tensor]] = []

    def training_step(self, batch: Batch, _: int) -> Tensor:
        mean, log_std, _ = self.network(batch["earlier"], batch["later"], batch.get("action"))
        pose_loss, likelihood = step_losses(mean, log_std, batch["relative"], self.network.relative_std)
        self.log_dict(
            {"pose_loss": pose_loss, "likelihood": likelihood},
            on_step=False,
            on_epoch=True,
            prog_bar=True,
            sync_dist=True,
        )
        return pose_loss + LIKELIHOOD_WEIGHT * likelihood

    def validation_step(self, batch: Batch, _: int) -> None:
        with torch.autocast(self.device.type, enabled=False):  # in the arithmetic of the estimator
            mean, log_std, _ = self.network(batch["earlier"], batch["later"], batch.get("action"))
        self.validation.append((mean, log_std, batch["relative"]))

    def on_validation_epoch_end(self) -> None:
        mean, log_std, truth = (torch.cat(parts) for parts in zip(*self.validation, strict=True))
        self.validation.clear()
        metrics = {f"validation_{k}": v for k, v in step_metrics(mean, log_std, truth).items()}
        self.log_dict(metrics, prog_bar=True, sync_dist=True)

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.arguments.learning_rate, weight_decay=1e-4)
        return runs.one_cycle(optimizer, self.trainer)


class _Data(lightning.LightningDataModule):
    def __init__(self, arguments: Arguments, world: World) -> None:
        super().__init__()
        self.arguments, self.world = arguments, world
        self.fixed: list[Batch] = []

    def train_dataloader(self) -> DataLoader[Batch]:
        assert self.trainer is not None
        a = self.arguments
        epoch, share = self.trainer.current_epoch, Share(self.trainer.global_rank, self.trainer.world_size)
        return loader(PairStream(self.world, TRAIN_SEEDS, epoch, a.datapoints, a.batch_size, share), a.workers)

    def val_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.validation(), batch_size=None)  # type: ignore[arg-type]

    def validation(self) -> list[Batch]:
        """The batches of the validation split, made when they are first needed."""
        if not self.fixed:
            self.fixed = episode_pairs(self.world, list(VALIDATION_SEEDS[: self.arguments.validation_mazes]))
        return self.fixed


def episode_pairs(world: World, seeds: list[int]) -> list[Batch]:
    """All consecutive frames of an episode in each of the mazes ``seeds``."""
    result = []
    for episode in simulate(world, seeds, 1000):
        images = images_of(world, episode)
        pairs = {"earlier": images[:-1], "later": images[1:], "relative": relative_poses(episode.poses_xyyaw)}
        if world.actions:
            pairs["action"] = torch.from_numpy(episode.actions).long()
        result.append(pairs)
    return result


def step_losses(mean: Tensor, log_std: Tensor, truth: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Smooth-L1 on relative poses ``(..., 3)`` in units of ``std``, and the likelihood of what ``log_std`` says."""
    error = (mean - truth) / std
    weight = error.new_tensor([1.0, 1.0, HEADING_WEIGHT])
    pose_loss = (smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=0.1) * weight).mean()
    log_scale = log_std - std.log()
    # The errors are detached: a network that may trade accuracy for a modest belief ends with less accuracy.
    likelihood = (0.5 * (error.detach() * torch.exp(-log_scale)).square().clamp(max=50.0) + log_scale).mean()
    return pose_loss, likelihood


def step_metrics(mean: Tensor, log_std: Tensor, truth: Tensor) -> dict[str, float]:
    """Errors a step: RMSE (m, deg), constant bias (m, deg) and how many predicted deviations the errors have."""
    error = mean - truth
    error = torch.cat((error[:, :2], se2.wrap(error[:, 2:])), dim=1).double()
    return {
        "rmse_m": float(error[:, :2].square().sum(1).mean().sqrt()),
        "rmse_deg": float(error[:, 2].square().mean().sqrt().rad2deg()),
        "bias_forward_m": float(error[:, 0].mean()),
        "bias_deg": float(error[:, 2].mean().rad2deg()),
        "normalized_error": float((error / log_std.exp()).square().mean().sqrt()),
    }


@torch.no_grad()
def calibrated(network: LocalPoseNetwork, pairs: list[Batch]) -> LocalPoseConfig:
    """The network's configuration with the bias and scale of each component that fit ``pairs`` best (least squares).

    The deviations get a scale each that makes their mean square that of the errors.
    """
    network = network.eval()
    parts = [network(p["earlier"], p["later"], p.get("action")) for p in pairs]
    estimates, log_std = (torch.cat([part[k] for part in parts]).double() for k in (0, 1))
    truth = torch.cat([p["relative"] for p in pairs]).double()
    mean, std = list(network.config.relative_mean), list(network.config.relative_std)
    fits = torch.zeros_like(truth)
    for i in range(3):
        fitted, _ = np.polyfit(estimates[:, i].numpy(), truth[:, i].numpy(), 1)
        scale = max(fitted, 0.01)  # what was not learned at all may fit best mirrored; a deviation stays positive
        bias = float((truth[:, i] - scale * estimates[:, i]).mean())
        mean[i], std[i] = float(scale * mean[i] + bias), float(scale * std[i])
        fits[:, i] = scale * estimates[:, i] + bias
        log_std[:, i] += math.log(scale)
    deviation = ((fits - truth) / log_std.exp()).square().mean(0).sqrt().clamp(min=0.01).tolist()
    return dataclasses.replace(
        network.config,
        relative_mean=(mean[0], mean[1], mean[2]),
        relative_std=(std[0], std[1], std[2]),
        deviation_scale=(deviation[0], deviation[1], deviation[2]),
    )


def main(arguments: Arguments) -> dict[str, float]:
    """Train, calibrate, write the weights, and return the validation metrics (in the first process, which does so)."""
    world = world_named(arguments.world)
    run = runs.Run(arguments.runs / world.name / "local", "train_local", arguments, arguments.epochs, arguments.seed)
    some = torch.cat([p["relative"] for p in episode_pairs(world, list(TRAIN_SEEDS[:8]))])
    config = LocalPoseConfig(
        image=world.image,
        width=arguments.width,
        actions=world.actions,
        period_s=world.period_s,
        relative_mean=(float(some[:, 0].mean()), 0.0, 0.0),
        relative_std=(float(some[:, 0].std()), float(some[:, 1].std()), float(some[:, 2].std())),
        symmetric=True,
        mirrored_actions=world.mirrored_actions,
    )
    training = LocalTraining(arguments, world, LocalPoseNetwork(config))
    data = _Data(arguments, world)
    run.fit(training, data)
    if not run.is_first:
        return {}
    training.cpu()
    unseen = episode_pairs(world, list(OPTIMIZER_TRAIN_SEEDS[-64:]))
    final = LocalPoseNetwork(calibrated(training.network, unseen)).eval()
    final.load_state_dict(training.network.state_dict())
    metrics = measure(final, data.validation())
    details = {"training": run.finish(metrics), "metrics": {"validation": metrics}}
    save_checkpoint(arguments.out / world.name / f"{LOCAL}.safetensors", final, LOCAL, world.name, details)
    print("validation", {name: round(value, 5) for name, value in metrics.items()})
    return metrics


@torch.no_grad()
def measure(network: LocalPoseNetwork, pairs: list[Batch]) -> dict[str, float]:
    """``step_metrics`` of a network over episodes."""
    parts = [network(p["earlier"], p["later"], p.get("action"))[:2] for p in pairs]
    truth = torch.cat([p["relative"] for p in pairs])
    return step_metrics(torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts]), truth)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
