"""Train the place encoder and its pair head on pairs of frames that show one place, well apart in time.

    python -m training.train_place --world maze2d

Run again, it goes on where it was stopped. It ends with the weights written into the estimator's package.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
import tyro
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy
from torch.utils.data import DataLoader

from ngo_estimator import se2
from ngo_estimator.checkpoint import PLACE, PlaceNetworks, save_checkpoint
from ngo_estimator.place_encoder import PlaceConfig
from training import runs
from training.streams import Batch, PlaceStream, Share, loader
from training.worlds import TRAIN_SEEDS, VALIDATION_SEEDS, World, WorldName, world_named


@dataclass(frozen=True)
class Arguments(runs.TrainerArguments):
    """Settings of a training of the place encoder."""

    world: WorldName
    """World to train for."""
    width: float = 0.19
    """Channels of the convolutions, as a fraction of FlowNetS's."""
    epochs: int = 10
    """Passes of new data."""
    batches: int = 256
    """Batches in an epoch, of all processes."""
    pairs_a_maze: int = 24
    """Pairs of frames from each of the 8 mazes of a batch."""
    learning_rate: float = 1.5e-3
    """Highest learning rate of the one-cycle schedule."""
    validation_batches: int = 16
    """Batches of the validation split that each epoch is measured on."""
    workers: int = 1
    """Processes that simulate for each one that trains."""
    seed: int = 0
    """Seed of the initial weights."""
    out: Path = runs.WEIGHTS
    """Folder that gets WORLD/place_encoder.safetensors."""
    runs: Path = runs.ROOT / "runs"
    """Folder of checkpoints and logs."""


class PlaceTraining(lightning.LightningModule):
    """Symmetric InfoNCE between the two frames of each place, and the pair head's likelihood and same-place loss.

    Frames of a maze that lie near each other without being a pair count neither for nor against.
    """

    BRIGHTNESS = 0.15

    def __init__(self, arguments: Arguments, world: World, networks: PlaceNetworks) -> None:
        super().__init__()
        self.arguments, self.world, self.networks = arguments, world, networks
        self.log_temperature = nn.Parameter(torch.tensor(2.5))

    def forward(self, batch: Batch, augment: bool) -> dict[str, Tensor]:
        """Losses and retrieval figures of a batch."""
        images = torch.cat((batch["a"], batch["b"]))
        if augment and images.dtype == torch.uint8:
            gain = 1.0 + self.BRIGHTNESS * (2.0 * torch.rand(len(images), 1, 1, 1, device=images.device) - 1.0)
            images = (images * gain).clamp(0, 255).to(torch.uint8)
        codes = self.networks.encoder(images)
        code_a, code_b = codes.chunk(2)
        embedding_a, embedding_b = self.networks.pair_head.embed(codes).float().chunk(2)
        similarity = embedding_a @ embedding_b.mT
        pose_a, pose_b = batch["poses"].unbind(1)
        ambiguous = (
            (batch["maze"][:, None] == batch["maze"])
            & (torch.cdist(pose_a[:, :2], pose_b[:, :2]) < 2.0 * self.world.place_radius_m)
            & ~torch.eye(len(pose_a), dtype=torch.bool, device=pose_a.device)
        )
        logits = (similarity * self.log_temperature.clamp(max=4.0).exp()).masked_fill(ambiguous, -1e4)
        target = torch.arange(len(pose_a), device=pose_a.device)
        contrast = 0.5 * (cross_entropy(logits, target) + cross_entropy(logits.mT, target))

        truth = se2.between(pose_a, pose_b)
        measured, log_scale, same = self.networks.pair_head(code_a, code_b)
        position_error = (measured[:, :2] - truth[:, :2]).norm(dim=1)
        heading_error = se2.wrap(measured[:, 2] - truth[:, 2]).abs()
        regression = (
            position_error * torch.exp(-log_scale[:, 0]) + 2.0 * log_scale[:, 0]
            + heading_error * torch.exp(-log_scale[:, 1]) + log_scale[:, 1]
        ).mean()  # fmt: skip
        # The hardest wrong partners, which retrieval will offer, are what the same-place belief has to tell apart.
        wrong = similarity.detach().masked_fill(ambiguous, -2.0).fill_diagonal_(-2.0).topk(2, dim=1).indices.T.flatten()
        _, _, other = self.networks.pair_head(code_a.repeat(2, 1), code_b[wrong])
        belief = binary_cross_entropy_with_logits(same, torch.ones_like(same)) + binary_cross_entropy_with_logits(
            other, torch.zeros_like(other)
        )
        return {
            "loss": contrast + regression + 0.5 * belief,
            "contrast": contrast,
            "precision_at_1": (logits.argmax(1) == target).float().mean(),
            "median_m": position_error.median(),
            "median_deg": heading_error.median().rad2deg(),
            "same_recall": (same > 0).float().mean(),
            "other_rejected": (other < 0).float().mean(),
        }

    def on_train_epoch_start(self) -> None:
        # The brightness of the pictures is random: a resumed training must draw what an unbroken one would have drawn.
        torch.manual_seed((self.arguments.seed * 1_000_003 + self.current_epoch) * 1_009 + self.global_rank)

    def training_step(self, batch: Batch, _: int) -> Tensor:
        figures = self(batch, augment=True)
        self.log_dict(figures, on_step=False, on_epoch=True, prog_bar=True, sync_dist=True)
        return figures["loss"]

    def validation_step(self, batch: Batch, _: int) -> None:
        with torch.autocast(self.device.type, enabled=False):  # in the arithmetic of the estimator
            figures = self(batch, augment=False)
        self.log_dict(
            {f"validation_{k}": v for k, v in figures.items()},
            on_epoch=True,
            prog_bar=True,
            batch_size=len(batch["a"]),
            sync_dist=True,
        )

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.arguments.learning_rate, weight_decay=1e-3)
        return runs.one_cycle(optimizer, self.trainer)


class _Data(lightning.LightningDataModule):
    def __init__(self, arguments: Arguments, world: World) -> None:
        super().__init__()
        self.arguments, self.world = arguments, world
        self.fixed: list[Batch] = []

    def train_dataloader(self) -> DataLoader[Batch]:
        assert self.trainer is not None
        a = self.arguments
        # A stream of its own: the local network's mazes come from the front of the range.
        seeds = TRAIN_SEEDS[len(TRAIN_SEEDS) // 2 :]
        epoch, share = self.trainer.current_epoch, Share(self.trainer.global_rank, self.trainer.world_size)
        return loader(PlaceStream(self.world, seeds, epoch, a.batches, a.pairs_a_maze, share), a.workers)

    def val_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.validation(), batch_size=None)  # type: ignore[arg-type]

    def validation(self) -> list[Batch]:
        """The batches of the validation split, made when they are first needed."""
        if not self.fixed:
            a = self.arguments
            self.fixed = list(PlaceStream(self.world, VALIDATION_SEEDS, 0, a.validation_batches, a.pairs_a_maze))
        return self.fixed


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics (in the first process, which does so)."""
    world = world_named(arguments.world)
    run = runs.Run(arguments.runs / world.name / "place", "train_place", arguments, arguments.epochs, arguments.seed)
    config = PlaceConfig(image=world.image, width=arguments.width, offset_scale_m=world.place_radius_m)
    training = PlaceTraining(arguments, world, PlaceNetworks(config))
    data = _Data(arguments, world)
    run.fit(training, data)
    if not run.is_first:
        return {}
    training.cpu().eval()
    with torch.no_grad():
        figures = [training(batch, augment=False) for batch in data.validation()]
    metrics = {name: float(torch.stack([f[name] for f in figures]).mean()) for name in figures[0]}
    details = {"training": run.finish(metrics), "metrics": {"validation": metrics}}
    save_checkpoint(arguments.out / world.name / f"{PLACE}.safetensors", training.networks, PLACE, world.name, details)
    print("validation", {name: round(value, 4) for name, value in metrics.items()})
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
