"""The folder of a run with its record, and its trainer, for all trainings."""

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, TQDMProgressBar

from training.common.curves import Batch, Curves, batch_size
from training.common.precision import Precision, resolved
from training.common.records import RunError, check_same_run, record, write_at_once
from training.common.trainer_arguments import TrainerArguments


class BestWeights(Callback):
    """Keeps the weights of the epoch with the lowest value of what is logged as ``name``.

    For small data, which networks begin to learn by heart. Its state travels in the checkpoint.
    """

    def __init__(self, name: str) -> None:
        self.name, self.value, self.epoch = name, float("inf"), -1
        self.weights: dict[str, torch.Tensor] = {}

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        value = float(trainer.callback_metrics.get(self.name, torch.tensor(float("inf"))))
        if value < self.value:
            self.value, self.epoch = value, trainer.current_epoch
            self.weights = {name: tensor.detach().cpu().clone() for name, tensor in pl_module.state_dict().items()}

    def restore(self, training: lightning.LightningModule) -> None:
        """Give the training the best weights, if there were any."""
        if self.weights:
            training.load_state_dict(self.weights)
            print(f"kept epoch {self.epoch + 1}, of the lowest {self.name} ({self.value:.4g})")

    def state_dict(self) -> dict[str, Any]:
        return {"value": self.value, "epoch": self.epoch, "weights": self.weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.value, self.epoch, self.weights = state_dict["value"], state_dict["epoch"], state_dict["weights"]


class SameStart(Callback):
    """Sees to it that all processes of a training go on from one checkpoint, before the first of them does."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def setup(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Raise ``RunError`` in every process where their folders hold different checkpoints."""
        if trainer.world_size == 1:
            return
        path = resume_from(self.folder)
        mine = "no checkpoint" if path is None else hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]
        found: list[str] = [""] * trainer.world_size
        torch.distributed.all_gather_object(found, mine)
        if len(set(found)) > 1:
            held = ", ".join(f"process {rank}: {what}" for rank, what in enumerate(found))
            raise RunError(
                f"{self.folder} is not the same for all processes ({held}); expected a folder that all machines share"
            )


class Run:
    """A training in a folder of its own: ``run.json``, ``metrics.csv`` and ``last.ckpt``, and its trainer.

    Begun again with the same arguments, it goes on after its last whole epoch and ends as if it had not been stopped.
    Several processes hold the same run; only the one that ``is_first`` writes. ``data`` identifies recordings, which
    count as arguments. They are small: of them the weights of the epoch with the lowest ``best``, a name that is
    logged, are kept, not the last ones. ``settings`` are those of the world that the training depends on.

    Raises:
        ValueError: the folder holds a run that was begun with other arguments or settings.
    """

    def __init__(
        self,
        folder: Path,
        script: str,
        arguments: TrainerArguments,
        epochs: int,
        datapoints: Callable[[Batch], int] = batch_size,
        best: str | None = None,
        data: str | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self.folder = folder
        check_launcher(arguments.num_nodes)
        why = ""
        if arguments.precision == "auto":
            precision, why = self._precision(arguments)
            arguments = dataclasses.replace(arguments, precision=precision)
        self.record = record(script, arguments)
        if data is not None:
            self.record["arguments"]["data_sha256"] = data
        if settings is not None:
            self.record["settings"] = dict(settings)
        self._description = {**self.record, "started": _now(), "resumed": [], "state": "running"}
        self._check_arguments()
        self.curves = Curves(folder / "metrics.csv", datapoints)
        self.best = None if best is None or data is None else BestWeights(best)
        callbacks = [SameStart(folder), self.curves, *([] if self.best is None else [self.best])]
        self.trainer = make_trainer(folder, epochs, arguments, callbacks)
        self.is_first = bool(self.trainer.is_global_zero)
        if why and self.is_first:
            print(f"precision {arguments.precision}: {why} (--precision chooses another)", flush=True)

    def _precision(self, arguments: TrainerArguments) -> tuple[Precision, str]:
        """The precision that the run began with, or the better one here; and why."""
        path = self.folder / "run.json"
        if path.exists() and resume_from(self.folder) is not None:
            begun: Precision = json.loads(path.read_text())["arguments"]["precision"]
            return begun, "as the run began"
        return resolved(arguments.accelerator, arguments.devices, arguments.num_nodes)

    def _check_arguments(self) -> None:
        path = self.folder / "run.json"
        if not path.exists() or resume_from(self.folder) is None:
            return
        begun = json.loads(path.read_text())
        now, then = ({**of["arguments"], **of.get("settings", {})} for of in (self.record, begun))
        check_same_run(self.folder, now, then)
        self._description = {**begun, "state": "running"}
        self._description["resumed"] = [*begun["resumed"], {"time": _now(), "revision": self.record["revision"]}]

    def fit(self, training: lightning.LightningModule, data: lightning.LightningDataModule) -> None:
        """Train to the last epoch, from the last one that was completed."""
        if self.is_first:
            self._write()
        self.trainer.fit(training, datamodule=data, ckpt_path=resume_from(self.folder))
        if self.best is not None:
            self.best.restore(training)

    def validate(self, training: lightning.LightningModule, data: lightning.LightningDataModule) -> dict[str, float]:
        """The validation figures of the present weights, by their logged names."""
        (logged,) = self.trainer.validate(training, datamodule=data, verbose=False)
        return {name: float(value) for name, value in logged.items()}

    def finish(self, metrics: dict[str, Any]) -> dict[str, Any]:
        """Complete ``run.json``; returns the ``training`` entry of the JSON beside the weights."""
        training = {**self.record, "processes": self.trainer.world_size, **self.curves.figures()}
        self._description = {**self._description, **training, "metrics": metrics, "ended": _now(), "state": "complete"}
        self._write()
        return training

    def ended(self, metrics: dict[str, float], begun: Mapping[str, str] | None = None) -> dict[str, Any]:
        """Complete and print; returns the entries of the JSON beside the weights, with what they ``begun`` from."""
        print("validation", {name: round(value, 5) for name, value in metrics.items()})
        return {"training": {**self.finish(metrics), **(begun or {})}, "metrics": {"validation": metrics}}

    def _write(self) -> None:
        write_at_once(self.folder / "run.json", json.dumps(self._description, indent=2) + "\n")


def check_launcher(num_nodes: int) -> None:
    """Raise ``RunError`` where several machines are to train together and nothing started this process as one of them.

    Without the check it would wait for the others for half an hour.
    """
    known = TorchElasticEnvironment.detect() or SLURMEnvironment.detect() or "NODE_RANK" in os.environ
    if num_nodes != 1 and not (known and num_nodes > 1):
        raise RunError(
            f"--num-nodes is {num_nodes}, and this process was started alone; expected 1, or a start by torchrun on "
            "each machine: see docs/how-to/train_the_shipped_networks.md"
        )


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def make_trainer(
    folder: Path, epochs: int, arguments: TrainerArguments, callbacks: Sequence[Callback]
) -> lightning.Trainer:
    """A trainer that keeps ``last.ckpt`` in ``folder`` after each epoch, and shows its progress; seeds all draws."""
    lightning.seed_everything(arguments.seed, workers=True)
    torch.set_float32_matmul_precision("high")
    checkpoint = ModelCheckpoint(dirpath=folder, filename="last", save_top_k=1, enable_version_counter=False)
    return lightning.Trainer(
        max_epochs=epochs,
        accelerator=arguments.accelerator,
        devices=arguments.devices,
        num_nodes=arguments.num_nodes,
        strategy=arguments.strategy,
        precision=arguments.precision,  # type: ignore[arg-type]
        gradient_clip_val=1.0,
        callbacks=[checkpoint, *callbacks, TQDMProgressBar(refresh_rate=20, leave=True)],
        logger=False,
        reload_dataloaders_every_n_epochs=1,
        # The streams deal the training data out themselves; every process measures all of the validation data, so that
        # medians and other figures that cannot be averaged come out as with one.
        use_distributed_sampler=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )


def one_cycle(optimizer: torch.optim.Optimizer, trainer: lightning.Trainer) -> dict[str, Any]:
    """Warm-up over a tenth of the training, then a cosine to zero, in the form that Lightning takes."""
    steps = int(trainer.estimated_stepping_batches)
    if steps < 3:
        raise RunError(f"the training has {steps} step(s) of the optimiser; expected at least 3, to warm up and cool")
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        [group["lr"] for group in optimizer.param_groups],
        total_steps=steps,
        pct_start=max(0.1, 2.0 / steps),
        div_factor=10.0,
        final_div_factor=100.0,
    )
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def resume_from(run: Path) -> str | None:
    """The run's last checkpoint, if it has one."""
    last = run / "last.ckpt"
    return str(last) if last.exists() else None
