"""The local network trained by two processes, as a program: ``python -m tests.smoke.two_processes FOLDER``.

Each writes the mazes that it trained on, the weights that it ended with and their error to ``FOLDER/rankN.json``.
"""

import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from safetensors.torch import save

from tests.smoke import toy
from training import train_local
from training.data.batches import Batch
from training.data.streams import PairStream


def main(folder: Path) -> None:
    patch = pytest.MonkeyPatch()
    toy.shrink(patch, 97, 300)
    made = PairStream.__iter__
    mazes: list[int] = []
    at_first: list[str] = []

    def noted(stream: PairStream) -> Iterator[Batch]:
        mazes.extend(seed for group in stream.groups for seed in group)
        yield from made(stream)

    def digest(self: Any) -> str:
        return hashlib.sha256(save(self.network.state_dict())).hexdigest()

    def note(self: Any) -> None:
        at_first.append(digest(self))

    def write(self: Any) -> None:
        result = {
            "mazes": mazes,
            "weights": digest(self),
            "weights_at_first": at_first[0],
            "logged_rmse_m": float(self.trainer.callback_metrics["validation_rmse_m"]),
            "rmse_m": train_local.measure(self.network.eval(), self.trainer.datamodule.validation)["rmse_m"],
        }
        (folder / f"rank{self.global_rank}.json").write_text(json.dumps(result))

    patch.setattr(PairStream, "__iter__", noted)
    patch.setattr(train_local.LocalTraining, "on_train_start", note)
    patch.setattr(train_local.LocalTraining, "on_train_end", write)
    processes: dict[str, Any] = {"devices": "2", "strategy": "ddp", "precision": "auto"}
    train_local.main(toy.local("maze2d", folder, epochs=2, accelerator="cpu", **processes))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
