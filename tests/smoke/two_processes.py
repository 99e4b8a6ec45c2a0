"""The local network trained by two processes, as a program: ``python -m tests.smoke.two_processes FOLDER [HOW]``.

They are of one machine, or of two where torchrun starts it with ``--nnodes 2``. With ``lost`` the second process dies
in the second epoch. With ``astray`` the second one is first given a folder of its own: what each says of that goes to
``FOLDER/astrayN.txt``, and both begin again. Each writes the mazes that it trained on, the weights that it ended with
and their error to ``FOLDER/rankN.json``.
"""

import hashlib
import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from safetensors.torch import save

from tests.smoke import toy
from training import train_local
from training.common.records import RunError
from training.data.batches import Batch
from training.data.streams import PairStream


def main(folder: Path, lost: bool, astray: bool) -> None:
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

    def die(self: Any) -> None:
        if lost and self.current_epoch == 1 and self.global_rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)

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
    patch.setattr(train_local.LocalTraining, "on_train_epoch_start", die)
    patch.setattr(train_local.LocalTraining, "on_train_end", write)
    nodes = int(os.environ.get("GROUP_WORLD_SIZE", "1"))
    processes: dict[str, Any] = {"devices": str(2 // nodes), "num_nodes": nodes, "strategy": "ddp", "precision": "auto"}

    def train(where: Path) -> None:
        train_local.main(toy.local("maze2d", where, epochs=2, accelerator="cpu", **processes))

    if astray:
        rank = int(os.environ["RANK"])
        with pytest.raises(RunError) as error:
            train(folder / "other" if rank else folder)
        (folder / f"astray{rank}.txt").write_text(str(error.value))
        at_first.clear()
        mazes.clear()
    train(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]), "lost" in sys.argv[2:], "astray" in sys.argv[2:])
