"""The record of how a network was made."""

from dataclasses import dataclass
from pathlib import Path

from training import runs


@dataclass(frozen=True)
class Arguments:
    world: str
    learning_rate: float = 1e-3
    batch_size: int = 8
    out: Path = Path("/somewhere")


def test_the_record_holds_a_command_that_makes_the_same_again() -> None:
    record = runs.record("train_local", Arguments("maze2d", batch_size=4, out=Path("/elsewhere")))
    assert record["command"] == "python -m training.train_local --world maze2d --batch-size 4"
    assert record["arguments"] == {"world": "maze2d", "learning_rate": 1e-3, "batch_size": 4}
    assert record["revision"]


def test_a_run_is_resumed_only_from_a_checkpoint_that_is_there(tmp_path: Path) -> None:
    assert runs.resume_from(tmp_path) is None
    (tmp_path / "last.ckpt").touch()
    assert runs.resume_from(tmp_path) == str(tmp_path / "last.ckpt")
