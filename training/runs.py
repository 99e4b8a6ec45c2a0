"""What all training scripts share: the trainer, the folder of a run, and the record of how a network was made."""

import dataclasses
import shlex
import subprocess
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS = ROOT / "ros_ws" / "src" / "ngo_estimator" / "weights"


def revision() -> str:
    """The commit that is checked out, with ``+changes`` where files differ from it."""
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True
        ).stdout.strip()
        changes = subprocess.run(
            ["git", "status", "--porcelain", "--untracked-files=no"],
            cwd=ROOT,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit + ("+changes" if changes.strip() else "")


def record(script: str, arguments: Any) -> dict[str, Any]:
    """How this run was made: command, arguments and revision, for the JSON beside its weights.

    Folders are left out: they say where a network was made, not how.
    """
    values, changed = {}, []
    for field in dataclasses.fields(arguments):
        value = getattr(arguments, field.name)
        if isinstance(value, Path):
            continue
        values[field.name] = value
        if value != field.default:
            changed += [f"--{field.name.replace('_', '-')}", str(value)]
    command = shlex.join(["python", "-m", f"training.{script}", *changed])
    return {"command": command, "arguments": values, "revision": revision()}


def make_trainer(run: Path, epochs: int, seed: int, precision: str, **options: Any) -> lightning.Trainer:
    """A trainer that logs to ``run/metrics.csv``, keeps ``run/last.ckpt`` after each epoch, and shows its progress."""
    lightning.seed_everything(seed, workers=True)
    torch.set_float32_matmul_precision("high")
    checkpoint = ModelCheckpoint(dirpath=run, filename="last", save_top_k=1, enable_version_counter=False)
    return lightning.Trainer(
        max_epochs=epochs,
        precision=precision,  # type: ignore[arg-type]
        gradient_clip_val=1.0,
        callbacks=[checkpoint, TQDMProgressBar(refresh_rate=20, leave=True)],
        logger=CSVLogger(run, name="", version=""),
        reload_dataloaders_every_n_epochs=1,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        **options,
    )


def one_cycle(optimizer: torch.optim.Optimizer, trainer: lightning.Trainer) -> dict[str, Any]:
    """Warm-up over a tenth of the training, then a cosine to zero, in the form that Lightning takes."""
    steps = int(trainer.estimated_stepping_batches)
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
