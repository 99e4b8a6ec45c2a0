"""Learning curves and figures that survive an interruption."""

import csv
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from training.common import curves
from training.common.curves import Curves, memory_mb


def trainer(epoch: int, **metrics: float) -> Any:
    return SimpleNamespace(
        current_epoch=epoch,
        global_step=10 * (epoch + 1),
        world_size=2,
        is_global_zero=True,
        callback_metrics={name: torch.tensor(value) for name, value in metrics.items()},
    )


def epoch(callback: Curves, number: int, clock: list[float], **metrics: float) -> None:
    """Ten batches of three datapoints in each of two processes, in four seconds."""
    now = trainer(number, **metrics)
    for index in range(10):
        callback.on_train_batch_end(now, SimpleNamespace(), None, {"x": torch.zeros(3, 7)}, index)  # type: ignore[arg-type]
    clock[0] += 4.0
    callback.on_train_epoch_end(now, SimpleNamespace())  # type: ignore[arg-type]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(curves, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


def test_the_curve_of_an_interrupted_training_has_every_epoch_once(tmp_path: Path, clock: list[float]) -> None:
    path = tmp_path / "run" / "metrics.csv"
    first = Curves(path)
    first.on_fit_start(trainer(0), SimpleNamespace())  # type: ignore[arg-type]
    epoch(first, 0, clock, loss=3.0)
    saved = first.state_dict()
    epoch(first, 1, clock, loss=9.0)  # written, but killed before the checkpoint

    clock[0] += 1000.0
    second = Curves(path)
    second.load_state_dict(saved)
    second.on_fit_start(trainer(1), SimpleNamespace())  # type: ignore[arg-type]
    epoch(second, 1, clock, loss=2.0, validation=0.123456789)
    rows = list(csv.DictReader(path.open()))
    assert [(row["epoch"], row["step"], row["seconds"], row["loss"]) for row in rows] == [
        ("0", "10", "4", "3"),
        ("1", "20", "8", "2"),
    ]
    assert [row["validation"] for row in rows] == ["", "0.1234568"]
    figures = second.figures()
    assert figures["seconds"] == 8.0
    assert figures["datapoints_per_s"] == 2 * 10 * 3 * 2 / 8.0


def test_an_unfinished_epoch_counts_nowhere(tmp_path: Path, clock: list[float]) -> None:
    callback = Curves(tmp_path / "metrics.csv", lambda batch: batch["x"].numel())
    epoch(callback, 0, clock)
    clock[0] += 50.0
    callback.on_train_batch_end(trainer(1), SimpleNamespace(), None, {"x": torch.zeros(3, 7)}, 0)  # type: ignore[arg-type]
    assert callback.figures()["seconds"] == 4.0
    assert callback.figures()["datapoints_per_s"] == 2 * 10 * 3 * 7 / 4.0


def test_memory_counts_what_child_processes_hold() -> None:
    before = memory_mb()
    assert before > 20.0
    hold = "import sys; x = bytearray(b'1') * 200_000_000; print('ready', flush=True); sys.stdin.read()"
    command = [sys.executable, "-S", "-c", hold]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        assert memory_mb() > before + 180.0
        child.communicate("")
    assert memory_mb() < before + 100.0
