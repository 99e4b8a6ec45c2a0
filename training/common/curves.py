"""Learning curves, time, throughput and memory of a training, kept over interruptions."""

import csv
import io
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from training.common.records import write_at_once

Batch = dict[str, Tensor]

_SAMPLE_S = 5.0  # the memory of other processes is asked for this often: it costs milliseconds


def batch_size(batch: Batch) -> int:
    """Datapoints in a batch whose every row is one."""
    return len(next(iter(batch.values())))


class Curves(Callback):
    """Writes ``metrics.csv``, one row an epoch, and counts time and datapoints; its state travels in the checkpoint.

    So an interrupted and resumed training has the whole curve, each epoch once, and the time that went into its
    weights; what was lost with an unfinished epoch counts nowhere. Columns are ``epoch``, ``step``, ``seconds`` (from
    the start, validation included) and whatever the training logs.
    """

    def __init__(self, path: Path, datapoints: Callable[[Batch], int] = batch_size) -> None:
        self.path, self.datapoints_of = path, datapoints
        self.curve: list[dict[str, float]] = []
        self.seconds = 0.0
        self.datapoints = 0
        self.peak_memory_mb = 0.0
        self._since = self._sampled = time.monotonic()
        self._unfinished = 0

    def figures(self) -> dict[str, float]:
        """``seconds``, ``datapoints_per_s`` and ``peak_memory_mb`` up to the last whole epoch, of all processes.

        The memory is the largest that this process ever had, and with it what its child processes held at most.
        """
        self._measure_memory()
        figures = {
            "seconds": round(self.seconds, 3),
            "datapoints_per_s": round(self.datapoints / max(self.seconds, 1e-9), 1),
            "peak_memory_mb": round(self.peak_memory_mb),
        }
        if torch.cuda.is_available():
            figures["peak_gpu_memory_mb"] = round(torch.cuda.max_memory_allocated() / 2**20)
        return figures

    def on_fit_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self._since = time.monotonic()

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
    ) -> None:
        self._unfinished += self.datapoints_of(batch) * trainer.world_size
        if batch_idx == 0 or time.monotonic() - self._sampled > _SAMPLE_S:
            self._measure_memory()

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        now = time.monotonic()
        self.seconds += now - self._since
        self.datapoints += self._unfinished
        self._since, self._unfinished = now, 0
        metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
        place = {"epoch": trainer.current_epoch, "step": trainer.global_step, "seconds": round(self.seconds, 1)}
        self.curve.append({**place, **metrics})
        if trainer.is_global_zero:
            self._write()

    def state_dict(self) -> dict[str, Any]:
        return {
            "curve": list(self.curve),
            "seconds": self.seconds,
            "datapoints": self.datapoints,
            "peak_memory_mb": self.peak_memory_mb,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.curve = list(state_dict["curve"])
        self.seconds, self.datapoints = state_dict["seconds"], state_dict["datapoints"]
        self.peak_memory_mb = max(self.peak_memory_mb, state_dict["peak_memory_mb"])

    def _measure_memory(self) -> None:
        self._sampled = time.monotonic()
        self.peak_memory_mb = max(self.peak_memory_mb, memory_mb())

    def _write(self) -> None:
        columns = list(dict.fromkeys(name for row in self.curve for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{value:.7g}" for name, value in row.items()} for row in self.curve)
        write_at_once(self.path, text.getvalue())


def memory_mb() -> float:
    """Largest resident memory that this process has had, and what its descendants hold now, MiB (Linux; else 0).

    Of pages that processes share, each descendant counts its part, on top of all of this process's own.
    """
    own = _kilobytes("/proc/self/status", "VmHWM:")
    return (own + sum(_kilobytes(f"/proc/{pid}/smaps_rollup", "Pss:") for pid in _descendants(os.getpid()))) / 1024


def _descendants(pid: int) -> list[int]:
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = [int(child) for child in path.read_text().split()]
        except OSError:  # the thread has just ended
            continue
        found += [one for child in children for one in (child, *_descendants(child))]
    return found


def _kilobytes(path: str, field: str) -> int:
    try:
        lines = Path(path).read_text().splitlines()
    except OSError:  # the process has just ended, or is no process of ours
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith(field)), 0)
