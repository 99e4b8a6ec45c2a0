"""What a training keeps: precision, learning curves, and the run that goes on."""

import csv
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import tyro

from training.common import curves, precision, records, runs
from training.common.curves import Curves, memory_mb
from training.common.precision import resolved
from training.common.trainer_arguments import TrainerArguments


@dataclass(frozen=True)
class Arguments(TrainerArguments):
    world: str
    learning_rate: float = 1e-3
    batch_size: int = 8


def begin(folder: Path, **changes: object) -> runs.Run:
    arguments = Arguments("maze2d", accelerator="cpu", precision="32-true", **changes)  # type: ignore[arg-type]
    return runs.Run(folder, "train_local", arguments, epochs=2)


def test_the_record_holds_a_command_that_makes_the_same_again() -> None:
    record = records.record("train_local", Arguments("maze2d", batch_size=4, out=Path("/elsewhere"), devices="2"))
    assert record["command"] == "python -m training.train_local --devices 2 --world maze2d --batch-size 4"
    expected = {"world": "maze2d", "learning_rate": 1e-3, "batch_size": 4}
    trainer = {
        "accelerator": "auto",
        "devices": "2",
        "num_nodes": 1,
        "strategy": "auto",
        "precision": "auto",
        "seed": 0,
    }
    assert record["arguments"] == {**trainer, **expected}
    assert record["revision"]


@dataclass(frozen=True)
class Switches:
    seen: bool = False
    robust: bool = True
    smoothing: bool | None = None
    prefixes: tuple[int, ...] = (1, 2)


def test_what_tables_write_is_no_change_of_what_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "ROOT", tmp_path)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
    files = [tmp_path / name for name in ("docs/results.md", "training/results/all.json", "training/code.py")]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("before")
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "All"]):
        subprocess.run([*git, *command], cwd=tmp_path, check=True)
    for file, changed in zip(files, (False, False, True), strict=True):
        file.write_text("after")
        assert records.revision().endswith("+changes") == changed


@pytest.mark.parametrize(
    ("given", "flags"),
    [
        (Switches(seen=True), " --seen"),
        (Switches(robust=False), " --no-robust"),
        (Switches(smoothing=True), " --smoothing True"),
        (Switches(prefixes=(5, 6, 7)), " --prefixes 5 6 7"),
        (Switches(), ""),
    ],
)
def test_the_command_is_one_that_the_command_line_takes(given: Switches, flags: str) -> None:
    command = records.record("results", given)["command"]
    assert command == f"python -m training.results{flags}"
    assert tyro.cli(Switches, args=command.split()[3:]) == given


def test_a_run_is_resumed_only_from_a_checkpoint_that_is_there(tmp_path: Path) -> None:
    assert runs.resume_from(tmp_path) is None
    (tmp_path / "last.ckpt").touch()
    assert runs.resume_from(tmp_path) == str(tmp_path / "last.ckpt")


def test_a_finished_run_says_how_it_was_made_and_what_came_out(tmp_path: Path) -> None:
    run = begin(tmp_path)
    training = run.finish({"rmse_m": 0.5})
    written = json.loads((tmp_path / "run.json").read_text())
    assert written["state"] == "complete" and written["metrics"] == {"rmse_m": 0.5} and written["resumed"] == []
    assert written["started"] <= written["ended"]
    assert written["arguments"]["learning_rate"] == 1e-3
    assert {name: written[name] for name in training} == training
    assert training["processes"] == 1
    assert training["peak_memory_mb"] > 10 and training["seconds"] == training["datapoints_per_s"] == 0.0


def test_a_run_does_not_go_on_with_other_arguments(tmp_path: Path) -> None:
    begin(tmp_path).finish({})
    begin(tmp_path, batch_size=4)  # nothing was trained yet
    (tmp_path / "last.ckpt").touch()
    begin(tmp_path, out=Path("/elsewhere"))  # says where, not how
    with pytest.raises(ValueError, match=r"given batch_size 4; expected batch_size 8 to go on with it"):
        begin(tmp_path, batch_size=4)


@pytest.mark.parametrize("nodes", [0, 2])
def test_a_training_on_machines_that_nothing_started_together_is_refused(nodes: int, tmp_path: Path) -> None:
    with pytest.raises(records.RunError, match=f"--num-nodes is {nodes}, and this process was started alone"):
        begin(tmp_path, num_nodes=nodes)


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


@pytest.mark.parametrize(("gain", "expected"), [(0.6, "32-true"), (1.2, "32-true"), (1.3, "bf16-mixed")])
def test_a_cpu_gets_bfloat16_only_where_that_is_clearly_faster(
    gain: float, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precision, "cpu_gain", lambda: gain)
    assert resolved("cpu", "auto", 1) == (expected, f"on this CPU bfloat16 has {gain:.2f} times the speed of float32")


@pytest.mark.parametrize(("supported", "expected"), [(True, "bf16-mixed"), (False, "32-true")])
def test_a_gpu_says_what_it_can(supported: bool, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: supported)
    assert resolved("auto", "auto", 1)[0] == resolved("gpu", "2", 1)[0] == expected


def test_a_run_says_its_precision_once_and_keeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def begin(wanted: precision.Precision = "auto") -> runs.Run:
        arguments = Arguments("maze2d", accelerator="cpu", precision=wanted)
        return runs.Run(tmp_path, "train_local", arguments, epochs=2)

    monkeypatch.setattr(precision, "cpu_gain", lambda: 0.5)
    run = begin()
    assert run.record["arguments"]["precision"] == "32-true" and run.trainer.precision == "32-true"
    assert "--precision 32-true" in run.record["command"]
    assert capsys.readouterr().out.splitlines() == [
        "precision 32-true: on this CPU bfloat16 has 0.50 times the speed of float32 (--precision chooses another)"
    ]
    run.finish({})
    (tmp_path / "last.ckpt").touch()
    monkeypatch.setattr(precision, "cpu_gain", lambda: 2.0)
    assert begin().record["arguments"]["precision"] == "32-true"
    assert json.loads((tmp_path / "run.json").read_text())["arguments"]["precision"] == "32-true"
    with pytest.raises(records.RunError, match="given precision bf16-mixed; expected precision 32-true"):
        begin("bf16-mixed")
