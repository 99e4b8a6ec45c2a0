"""What trainings of networks have in common: what is logged when, the optimiser and its schedule, and the weights."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Protocol

import lightning
import torch
from torch import Tensor, nn
from tqdm import trange

from ngo_estimator.checkpoint import save_checkpoint
from training.common import runs
from training.common.curves import Batch, batch_size

Figures = Mapping[str, Tensor | float]


class Schedule(Protocol):
    """The arguments that a training's schedule comes from."""

    @property
    def learning_rate(self) -> float: ...


class Training(lightning.LightningModule):
    """A task: its networks, the loss that they learn by, and the figures that they are measured by.

    AdamW, one cycle of the learning rate. Figures are means over the validation batches, in the estimator's arithmetic.
    """

    weight_decay: ClassVar[float] = 1e-4

    def __init__(self, arguments: Schedule) -> None:
        super().__init__()
        self.arguments = arguments

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and what is logged of it."""
        raise NotImplementedError

    def figures(self, batch: Batch) -> Figures:
        """The figures of a validation batch."""
        raise NotImplementedError

    def parameter_groups(self) -> list[dict[str, Any]]:
        """What learns, each group with its highest learning rate."""
        return [{"params": list(self.parameters()), "lr": self.arguments.learning_rate}]

    def training_step(self, batch: Batch, _: int) -> Tensor:
        loss, logged = self.losses(batch)
        self._log(logged, batch, on_step=False)
        return loss

    def validation_step(self, batch: Batch, _: int) -> None:
        with torch.autocast(self.device.type, enabled=False):
            self._log(self.figures(batch), batch)

    def configure_optimizers(self) -> Any:
        return runs.one_cycle(torch.optim.AdamW(self.parameter_groups(), weight_decay=self.weight_decay), self.trainer)

    def _log(self, values: Figures, batch: Batch, **options: Any) -> None:
        size = batch_size(batch)
        self.log_dict(values, on_epoch=True, prog_bar=True, sync_dist=True, batch_size=size, **options)


class OverallTraining(Training):
    """One whose figures, such as root mean squares, are those of all validation batches together."""

    def __init__(self, arguments: Schedule) -> None:
        super().__init__(arguments)
        self._validation: list[tuple[Tensor, ...]] = []

    def estimates(self, batch: Batch) -> tuple[Tensor, ...]:
        """What ``overall`` takes, of one batch."""
        raise NotImplementedError

    def overall(self, *columns: Tensor) -> Figures:
        """The figures of all batches' estimates."""
        raise NotImplementedError

    def validation_step(self, batch: Batch, _: int) -> None:
        with torch.autocast(self.device.type, enabled=False):
            self._validation.append(self.estimates(batch))

    def on_validation_epoch_end(self) -> None:
        figures = self.overall(*(torch.cat(column) for column in zip(*self._validation, strict=True)))
        self._validation.clear()
        self.log_dict(figures, prog_bar=True, sync_dist=True)


def descend(
    parameters: Iterable[nn.Parameter],
    loss_of: Callable[[int], Tensor],
    steps: int,
    schedule: Callable[[torch.optim.Optimizer], torch.optim.lr_scheduler.LRScheduler],
    largest_norm: float | None = None,
    **adamw: float,
) -> list[float]:
    """Train by AdamW without the framework, for data that memory holds; returns the loss of each step."""
    parameters, losses = list(parameters), []
    optimizer = torch.optim.AdamW(parameters, **adamw)  # type: ignore[arg-type]
    rate = schedule(optimizer)
    for step in trange(steps, desc="train", unit="step"):
        loss = loss_of(step)
        optimizer.zero_grad()
        loss.backward()
        if largest_norm is not None:
            nn.utils.clip_grad_norm_(parameters, largest_norm)
        optimizer.step()
        rate.step()
        losses.append(loss.item())
    return losses


def save_weights(folder: Path, network: nn.Module, kind: str, details: dict[str, Any], half: bool = False) -> None:
    """Write FOLDER/KIND.safetensors and its JSON, where FOLDER has the name of the world or the robot."""
    save_checkpoint(folder / f"{kind}.safetensors", network, kind, folder.name, details, half=half)
