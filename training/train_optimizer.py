"""Train the pose aggregation and the Neural Graph Optimizer on whole trajectories of the feature store.

    python -m training.train_optimizer --world maze2d

Run again, it goes on where it was stopped. It ends with the weights written into the estimator's package.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import torch
import tyro
from torch import Tensor, nn
from torch.nn.functional import huber_loss
from torch.utils.data import DataLoader, IterableDataset

from ngo_estimator import se2
from ngo_estimator.checkpoint import OPTIMIZER, load_local, load_place, save_checkpoint
from ngo_estimator.neural_graph_optimizer import NeuralGraphOptimizer, NeuralGraphOptimizerConfig
from ngo_estimator.place_encoder import PairHead
from ngo_estimator.pose_aggregation import PoseAggregationConfig, poses_in_blocks
from training import runs
from training.featurise import check_networks, open_store
from training.streams import Batch
from training.worlds import world_named


@dataclass(frozen=True)
class Arguments:
    """Settings of a training of the optimizer."""

    world: Literal["maze2d", "maze3d"]
    """World to train for."""
    form: Literal["loops", "paper"] = "loops"
    """With loop closures, or the paper's form."""
    iterations: int = 5
    """Attend-optimise iterations."""
    width: int = 64
    """Channels of aggregation and optimizer."""
    max_loops: int = 96
    """Loop candidates of a trajectory."""
    epochs: int = 20
    """Epochs; the learning rate falls to zero over all of them."""
    steps: int = 40
    """Steps of the optimiser in an epoch."""
    batch_size: int = 8
    """Trajectories in a step."""
    learning_rate: float = 1e-3
    """Highest learning rate."""
    seed: int = 0
    """Seed of initial weights and of the order of the data."""
    weights: Path = runs.WEIGHTS
    """Folder with the world's other networks; gets WORLD/neural_graph_optimizer.safetensors."""
    runs: Path = runs.ROOT / "runs"
    """Folder of the feature store, checkpoints and logs."""


class Trajectories(IterableDataset[Batch]):
    """Random crops and mirror images of the stored trajectories; an epoch is a function of its number and the seed."""

    def __init__(self, store: Path, arguments: Arguments, epoch: int, block: int) -> None:
        self.arrays = open_store(store)
        self.arguments, self.epoch, self.block = arguments, epoch, block

    def __len__(self) -> int:
        return self.arguments.steps

    def __iter__(self) -> Iterator[Batch]:
        rng = np.random.default_rng([self.arguments.seed, self.epoch])
        trajectories, steps = self.arrays["relative"].shape[:2]
        for _ in range(self.arguments.steps):
            # Short ones too: online, every trajectory is short at first.
            length = int(rng.choice([steps, steps, steps // 2, steps // 4])) // self.block * self.block
            chosen = np.sort(rng.choice(trajectories, self.arguments.batch_size, replace=False))
            start = int(rng.integers(0, steps - length + 1))
            yield crop(self.arrays, chosen, start, length)


def crop(arrays: dict[str, np.ndarray], chosen: np.ndarray, start: int, length: int) -> Batch:
    """A batch of trajectories from step ``start`` on; ``truth`` is seen from the frame before that step."""
    batch = {name: torch.from_numpy(array[chosen, start : start + length]) for name, array in arrays.items()}
    if start:
        batch["truth"] = se2.between(torch.from_numpy(arrays["truth"][chosen, start - 1])[:, None], batch["truth"])
    # The continuous heading of a whole trajectory, which the network's sums of turns are compared with.
    batch["truth"][..., 2] = torch.from_numpy(np.unwrap(batch["truth"][..., 2].numpy(), axis=-1))
    return {name: value.float() for name, value in batch.items()}


class OptimizerTraining(lightning.LightningModule):
    """Huber losses on global and relative meta-poses after every iteration."""

    HEADING_WEIGHT = 3.0
    RELATIVE_WEIGHT = 0.5

    def __init__(
        self, arguments: Arguments, optimizer: NeuralGraphOptimizer, pair_head: PairHead, scale_m: float
    ) -> None:
        super().__init__()
        self.arguments, self.optimizer, self.scale_m = arguments, optimizer, scale_m
        self.pair_head = pair_head
        self.block = optimizer.config.aggregation.block

    def forward(self, batch: Batch) -> Any:
        codes = batch["codes"] if self.optimizer.config.loops else None
        return self.optimizer(batch["relative"], batch["log_std"], batch["motion"], codes, self.pair_head)

    def training_step(self, batch: Batch, _: int) -> Tensor:
        result = self(batch)
        truth = batch["truth"][:, self.block - 1 :: self.block]
        truth_relative = se2.g2r(truth)
        loss, weight_sum = truth.new_zeros(()), 0.0
        count = len(result.meta_relative)
        for number, relative in enumerate(result.meta_relative, start=1):
            weight = number / count
            error = se2.r2g(relative) - truth
            position = huber_loss(error[..., :2] / self.scale_m, torch.zeros_like(error[..., :2]), delta=1.0)
            heading = huber_loss(error[..., 2] * 5.0, torch.zeros_like(error[..., 2]), delta=1.0) / 5.0
            step = (relative - truth_relative) / self.optimizer.correction_std
            local = huber_loss(step, torch.zeros_like(step), delta=1.0)
            loss = loss + weight * (position + self.HEADING_WEIGHT * heading + self.RELATIVE_WEIGHT * local)
            weight_sum += weight
        loss = loss / weight_sum
        self.log("loss", loss, on_step=False, on_epoch=True, prog_bar=True)
        return loss

    def validation_step(self, batch: Batch, _: int) -> None:
        for name, poses in (("odometry", se2.r2g(batch["relative"])), ("corrected", self(batch).poses)):
            error = (poses - batch["truth"])[..., :2].norm(dim=-1).square().mean(dim=1).sqrt()
            heading = (poses - batch["truth"])[..., 2].square().mean(dim=1).sqrt().rad2deg()
            figures = {
                f"{name}_m": error.mean(),
                f"{name}_median_m": error.median(),
                f"{name}_deg": heading.mean(),
            }
            self.log_dict(figures, on_epoch=True, prog_bar=True, batch_size=len(error))

    def configure_optimizers(self) -> Any:
        slow: list[nn.Parameter] = []
        fast: list[nn.Parameter] = []
        for name, parameter in self.optimizer.named_parameters():
            # Single numbers that start from zero, and hold everything else back until they move.
            (fast if name in ("loop_gain", "place_gain") else slow).append(parameter)
        rate = self.arguments.learning_rate
        groups: list[dict[str, Any]] = [{"params": slow}, {"params": fast, "lr": 20.0 * rate, "weight_decay": 0.0}]
        optimizer = torch.optim.AdamW(groups, lr=rate, weight_decay=1e-3)
        return runs.one_cycle(optimizer, self.trainer)


class _Data(lightning.LightningDataModule):
    def __init__(self, arguments: Arguments, store: Path, block: int) -> None:
        super().__init__()
        self.arguments, self.store, self.block = arguments, store, block
        arrays = open_store(store / "validation")
        trajectories, steps = arrays["relative"].shape[:2]
        whole = steps // block * block
        rows = np.array_split(np.arange(trajectories), max(1, trajectories // 8))
        self.fixed = [crop(arrays, chosen, 0, whole) for chosen in rows]

    def train_dataloader(self) -> DataLoader[Batch]:
        assert self.trainer is not None
        data = Trajectories(self.store / "train", self.arguments, self.trainer.current_epoch, self.block)
        return DataLoader(data, batch_size=None)

    def val_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.fixed, batch_size=None)  # type: ignore[arg-type]


def correction_scale(store: Path, block: int) -> tuple[float, float, float]:
    """Standard deviation (m, m, rad) of the odometry's error over a meta-pose, in a feature store."""
    arrays = open_store(store)
    whole = arrays["relative"].shape[1] // block * block
    batch = crop(arrays, np.arange(len(arrays["relative"])), 0, whole)
    error = poses_in_blocks(batch["relative"], block)[..., -1, :] - se2.g2r(batch["truth"][:, block - 1 :: block])
    x, y, yaw = error.square().mean(dim=(0, 1)).sqrt().tolist()
    return x, y, yaw


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics."""
    world = world_named(arguments.world)
    folder = arguments.weights / world.name
    local, local_description = load_local(folder, world.name)
    place, place_description = load_place(folder, world.name)
    store = arguments.runs / world.name / "features"
    run = arguments.runs / world.name / f"optimizer-{arguments.form}-{arguments.iterations}-seed{arguments.seed}"
    trainer = runs.make_trainer(run, arguments.epochs, arguments.seed, "32-true")
    aggregation = PoseAggregationConfig(
        motion_feature_size=local.config.feature_size,
        width=arguments.width,
        relative_std=local.config.relative_std,
    )
    for split in ("train", "validation"):
        check_networks(store / split, local_description, place_description)
    scale = correction_scale(store / "validation", aggregation.block)
    make = NeuralGraphOptimizerConfig if arguments.form == "loops" else NeuralGraphOptimizerConfig.paper_form
    config = make(
        aggregation=aggregation,
        iterations=arguments.iterations,
        max_loops=arguments.max_loops,
        correction_std=scale,
    )
    training = OptimizerTraining(arguments, NeuralGraphOptimizer(config), place.pair_head, world.block_m)
    data = _Data(arguments, store, aggregation.block)
    started = time.monotonic()
    trainer.fit(training, datamodule=data, ckpt_path=runs.resume_from(run))
    metrics = {
        name: float(value) for name, value in trainer.validate(training, datamodule=data, verbose=False)[0].items()
    }
    details = {
        "place_encoder_sha256": place_description["sha256"],
        "training": {**runs.record("train_optimizer", arguments), "seconds": round(time.monotonic() - started)},
        "metrics": {"validation": metrics},
    }
    save_checkpoint(folder / f"{OPTIMIZER}.safetensors", training.optimizer, OPTIMIZER, world.name, details)
    print("validation", {name: round(value, 4) for name, value in metrics.items()})
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
