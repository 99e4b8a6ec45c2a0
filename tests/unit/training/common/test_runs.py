"""The record of how a network was made, and the folder of its training."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro

from training.common import records, runs
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
